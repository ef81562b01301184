//! Encoding of captured images as a scene: contexts, tokens, clusters, condenser.
// N encoder tokens, S stored tokens, D width

use burn::tensor::Tensor;
use clift_data::{ClipReader, Pose, PoseNormalization, ViewIndices, contexts_along_path, derive_seed};
use clift_model::{
    Clusters, Grouping, KMeans, ModelError, Scene, SceneClusters, SceneModel, SceneNormalization, TokenCount,
    TokenKind, TrainedModel, total_variance,
};

use crate::error::EvalError;
use crate::upload::{upload_views, view_cameras};

/// Settings of [`encode`].
#[derive(Clone, Debug, PartialEq)]
pub struct EncodeOptions {
    /// Context frames; `None` for `num_context` frames along the camera path.
    pub context: Option<Vec<usize>>,
    /// Number of context views without `context`, such as the number in training.
    pub num_context: usize,
    /// Number of stored tokens.
    pub storage: TokenCount,
    /// Token groups that the model was trained on.
    pub grouping: Grouping,
    /// Latent K-means.
    pub kmeans: KMeans,
    /// Seed of the run.
    pub seed: u64,
    /// Path of the model for the scene file, see [`Scene::model_path_for`].
    pub model_path: String,
}

/// An encoded scene.
#[derive(Clone, Debug)]
pub struct EncodedScene {
    /// The scene.
    pub scene: Scene,
    /// Number of tokens before clustering.
    pub num_lift_tokens: usize,
    /// Variance within clusters as a share of the total variance of the tokens.
    pub cluster_error: f64,
    /// Clusters of the tokens.
    pub clusters: SceneClusters,
}

impl EncodedScene {
    /// Orders the tokens by their patches, as files with coded tokens do.
    ///
    /// # Errors
    /// The errors of the clusters, which stay valid.
    pub fn sort_tokens(&mut self) -> Result<(), EvalError> {
        let (ids, dim) = (&self.scene.token_ids, self.scene.model.dim);
        let mut order: Vec<usize> = (0..ids.len()).collect();
        order.sort_by_key(|&token| ids[token]);
        let mut place = vec![0; ids.len()];
        order.iter().enumerate().for_each(|(new, &old)| place[old] = new as u32);
        let assignment = self.clusters.assignment().iter().map(|&cluster| place[cluster as usize]).collect();
        let tokens = order.iter().flat_map(|&old| &self.scene.tokens[old * dim..(old + 1) * dim]).copied().collect();
        self.scene.token_ids = order.iter().map(|&old| ids[old]).collect();
        self.scene.tokens = tokens;
        self.clusters = SceneClusters::new(assignment, self.scene.token_ids.clone())?;
        Ok(())
    }
}

/// Encodes a scene of `reader`. The clusters equal those of `clift eval` for the same contexts and count.
///
/// # Errors
/// [`ModelError::BadConfig`] for frames that the scene does not have, [`ModelError::BadTokenCount`] for a count above the
/// number of tokens, [`ModelError::BadConfig`] for fewer latents of LVSM than all, and the errors of reading the images.
pub fn encode(
    model: &TrainedModel,
    reader: &ClipReader,
    scene: usize,
    options: &EncodeOptions,
) -> Result<EncodedScene, EvalError> {
    if options.grouping != Grouping::Kmeans {
        let fix = "scene files need K-means tokens: encode with a run with clusters.grouping = \"kmeans\"".into();
        return Err(bad_config("clusters.grouping", "\"tile\"".into(), fix));
    }
    let key = reader.source.key(scene);
    let poses: Vec<Pose> = reader.source.cameras(scene)?.iter().map(|camera| camera.c2w).collect();
    let frames = context_frames(&poses, options.context.as_deref(), options.num_context)?;
    let context_poses: Vec<Pose> = frames.iter().map(|&frame| poses[frame]).collect();
    let views = ViewIndices { context: frames, target: Vec::new() };
    let clip = reader.read(scene, &views)?;
    let data = &reader.options;
    let frame = PoseNormalization::find(key, &context_poses, &[], data.pose_rotation, data.pose_scale)?;

    let lift = model.network.encode(&upload_views(&[&clip.context], &model.device)?); // [1, N, D]
    let [_, num_lift_tokens, dim] = lift.dims();
    let seed = derive_seed(derive_seed(options.seed, "eval"), key);
    let (clusters, cluster_error) = if model.config.has_latents() {
        if options.storage.of(num_lift_tokens)? != num_lift_tokens {
            let fix =
                format!("a scene of lvsm-ed is all its latents, which are not clustered: write {num_lift_tokens}");
            return Err(bad_config("--storage", options.storage.to_string(), fix));
        }
        (Clusters::new(vec![SceneClusters::identity(num_lift_tokens)])?, 0.0)
    } else {
        cluster(&options.kmeans, &lift.values, options.storage, seed)?
    };
    let index = clusters.upload(&model.device);
    let (kind, tokens) = if model.config.has_latents() {
        (TokenKind::Latents, lift)
    } else if model.has_condenser {
        (TokenKind::Clift, model.network.compress(lift, &index))
    } else {
        (TokenKind::Kmeans, lift.centroids(&index))
    };
    let tokens = tokens.values.into_data().convert::<f32>().try_to_vec::<f32>().map_err(EvalError::tensor)?;
    let clusters = clusters.scenes()[0].clone();
    let token_ids = clusters.centroid_index().to_vec();
    debug_assert_eq!(tokens.len(), token_ids.len() * dim, "a row per centroid");
    let scene = Scene {
        key: key.into(),
        kind,
        model: model.config.clone(),
        renderer_hash: model.renderer_hash(),
        model_path: options.model_path.clone(),
        height: data.height,
        width: data.width,
        context: view_cameras(&clip.context),
        context_frames: views.context.iter().map(|&frame| frame as u32).collect(),
        world: SceneNormalization { mean_c2w: frame.mean_c2w.to_matrix_f64(), scale: frame.scale },
        token_ids,
        tokens,
    };
    Ok(EncodedScene { scene, num_lift_tokens, cluster_error, clusters })
}

/// Checks the requested context frames, or chooses `num_views` frames along the camera path.
fn context_frames(poses: &[Pose], requested: Option<&[usize]>, num_views: usize) -> Result<Vec<usize>, EvalError> {
    let num_frames = poses.len();
    let bad = |value: String, fix: String| bad_config("--context", value, fix);
    let Some(requested) = requested else {
        return contexts_along_path(poses, num_views.min(num_frames)).ok_or_else(|| {
            bad(num_views.to_string(), format!("the scene has {num_frames} frames; list the frames to use"))
        });
    };
    let list = requested.iter().map(ToString::to_string).collect::<Vec<_>>().join(",");
    let mut sorted = requested.to_vec();
    sorted.sort_unstable();
    sorted.dedup();
    if requested.len() < 2 || sorted.len() < requested.len() {
        return Err(bad(list, "write at least two frames, each once".into()));
    }
    if let Some(frame) = requested.iter().find(|frame| **frame >= num_frames) {
        let last = num_frames.saturating_sub(1);
        return Err(bad(list, format!("there is no frame {frame}; the scene has frames 0 to {last}")));
    }
    Ok(requested.to_vec())
}

fn bad_config(key: &'static str, value: String, fix: String) -> EvalError {
    ModelError::BadConfig { key, value, fix }.into()
}

/// Returns the clusters, and the variance within clusters as a share of the total variance.
fn cluster(kmeans: &KMeans, lift: &Tensor<3>, storage: TokenCount, seed: u64) -> Result<(Clusters, f64), EvalError> {
    let [_, num_tokens, _] = lift.dims();
    let fit = kmeans.fit(lift.clone(), storage.of(num_tokens)?, &[seed])?;
    let error = fit.error(0, total_variance(lift)?[0]);
    Ok((fit.clusters, error))
}

#[cfg(test)]
mod tests {
    use burn::tensor::{Device, TensorData};

    use super::*;

    /// Tokens of two values in two distant groups, with a little noise.
    fn tokens(num_tokens: usize) -> Tensor<3> {
        let value = |i: usize| [(i % 2) as f32 * 10.0, ((i * 7919) % 101) as f32 * 1e-3];
        let values: Vec<f32> = (0..num_tokens).flat_map(value).collect();
        Tensor::from_data(TensorData::new(values, [1, num_tokens, 2]), &Device::flex())
    }

    #[test]
    fn the_error_is_the_share_of_variance_within_clusters() {
        let lift = tokens(64);
        let values: Vec<f32> = lift.to_data().try_to_vec().unwrap();
        let rows: Vec<[f64; 2]> = values.chunks(2).map(|row| [f64::from(row[0]), f64::from(row[1])]).collect();
        let spread = |rows: &[[f64; 2]]| {
            let mean = [0, 1].map(|i| rows.iter().map(|row| row[i]).sum::<f64>() / rows.len() as f64);
            rows.iter().flat_map(|row| [row[0] - mean[0], row[1] - mean[1]]).map(|d| d * d).sum::<f64>()
        };
        let (even, odd): (Vec<_>, Vec<_>) = rows.iter().partition(|row| row[0] == 0.0);
        let expected = (spread(&even) + spread(&odd)) / spread(&rows);
        let (_, error) = cluster(&KMeans::default(), &lift, TokenCount::Count(2), 1).unwrap();
        assert!((error / expected - 1.0).abs() < 1e-3, "{error} against {expected}"); // f32
        let lift = Tensor::<3>::ones([1, 8, 2], &Device::flex());
        assert_eq!(cluster(&KMeans::default(), &lift, TokenCount::Count(2), 1).unwrap().1, 0.0);
    }

    #[test]
    fn context_frames_are_checked_or_spread() {
        let at = |x: f64| Pose { translation: [x, 0.0, 0.0].into(), ..Pose::IDENTITY };
        let poses: Vec<Pose> = (0..10).map(f64::from).map(at).collect();
        assert_eq!(context_frames(&poses, None, 4).unwrap(), [0, 3, 6, 9]);
        assert_eq!(context_frames(&poses[..3], None, 4).unwrap(), [0, 1, 2]);
        assert_eq!(context_frames(&poses, Some(&[7, 2]), 4).unwrap(), [7, 2]);
        let message = |frames: &[usize]| context_frames(&poses, Some(frames), 4).unwrap_err().to_string();
        assert_eq!(message(&[0, 10]), "`--context` = 0,10: there is no frame 10; the scene has frames 0 to 9");
        assert_eq!(message(&[3, 3]), "`--context` = 3,3: write at least two frames, each once");
        assert_eq!(message(&[3]), "`--context` = 3: write at least two frames, each once");
    }
}
