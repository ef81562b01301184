//! Encoding of captured images as a scene: contexts, tokens, clusters, condenser.
// N encoder tokens, S stored tokens, D width

use clift_core::{Pose, PoseNormalization, derive_seed};
use clift_data::{ClipReader, DataError, ViewIndices, contexts_along_path};
use clift_model::{Clusters, Grouping, KMeans, ModelError, SceneClusters, TokenCount, TokenKind, TrainedModel, Views};

use crate::error::SceneError;
use crate::scene::scene::Scene;

/// Settings of [`encode`].
#[derive(Clone, Debug, PartialEq)]
pub struct EncodeOptions {
    /// Context frames; `None` for `num_context` frames along the camera path.
    pub context: Option<Vec<usize>>,
    /// Number of context views without `context`, such as the number in training.
    pub num_context: usize,
    /// Number of stored tokens.
    pub stored_tokens: TokenCount,
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
    pub fn sort_tokens(&mut self) -> Result<(), SceneError> {
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

/// Chooses `num_views` context frames of a scene, or all its frames if it has fewer, at equal distances along the camera
/// path, as [`encode`] does without [`EncodeOptions::context`].
///
/// # Errors
/// Those of the cameras, and [`CameraError::ZeroBaseline`](clift_core::CameraError::ZeroBaseline) for frames without a scale.
pub fn spread_contexts(reader: &ClipReader, scene: usize, num_views: usize) -> Result<Vec<usize>, SceneError> {
    let (context, _) = contexts(reader, scene, None, num_views)?;
    Ok(context)
}

/// Encodes a scene of `reader`. The groups equal those of `clift eval` for the same contexts and count.
///
/// # Errors
/// [`ModelError::BadConfig`] for frames that the scene does not have, [`ModelError::BadTokenCount`] for a count above the
/// number of tokens, [`ModelError::BadConfig`] for fewer tokens than all of a network without clusters, and the errors of reading the images.
pub fn encode(
    model: &TrainedModel,
    reader: &ClipReader,
    scene: usize,
    options: &EncodeOptions,
) -> Result<EncodedScene, SceneError> {
    let (key, data) = (reader.source.key(scene), &reader.options);
    let (context, frame) = contexts(reader, scene, options.context.as_deref(), options.num_context)?;
    let views = ViewIndices { context, target: Vec::new() };
    let clip = reader.read(scene, &views)?;

    let lift = model.network.encode(&Views::upload(&[&clip.context], &model.device)?); // [1, N, D]
    let [_, num_lift_tokens, dim] = lift.dims();
    let seed = derive_seed(derive_seed(options.seed, "eval"), key);
    let architecture = model.config.architecture;
    let clusters = if architecture.supports_clusters() {
        let grid = [data.height, data.width].map(|side| side / model.config.patch_size);
        let (count, kmeans) = (options.stored_tokens.of(num_lift_tokens)?, (&options.kmeans, seed));
        options.grouping.group(count, (clip.context.num_views(), grid), kmeans, || lift.values.clone())?
    } else {
        if options.stored_tokens.of(num_lift_tokens)? != num_lift_tokens {
            let fix = format!(
                "a scene of {architecture} is all its tokens, which are not clustered: write {num_lift_tokens}"
            );
            return Err(bad_config("--stored-tokens", options.stored_tokens.to_string(), fix));
        }
        SceneClusters::identity(num_lift_tokens)
    };
    let cluster_error = clusters.variance_within(&lift.to_host()?);
    let index = Clusters::new(vec![clusters.clone()])?.upload(&model.device);
    let (kind, tokens) = if !architecture.supports_clusters() {
        (TokenKind::All, lift)
    } else if model.has_condenser {
        (TokenKind::Clift, model.network.compress(lift, &index))
    } else {
        (TokenKind::Kmeans, lift.centroids(&index))
    };
    let tokens = tokens.to_host()?;
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
        context: clip.context.cameras,
        context_frames: views.context.iter().map(|&frame| frame as u32).collect(),
        world: frame,
        token_ids,
        tokens,
    };
    Ok(EncodedScene { scene, num_lift_tokens, cluster_error, clusters })
}

/// Returns the context frames of a scene and the frame of its poses.
fn contexts(
    reader: &ClipReader,
    scene: usize,
    requested: Option<&[usize]>,
    num_views: usize,
) -> Result<(Vec<usize>, PoseNormalization), SceneError> {
    let (key, data) = (reader.source.key(scene), &reader.options);
    let poses: Vec<Pose> = reader.source.cameras(scene)?.iter().map(|camera| camera.c2w).collect();
    let frames = context_frames(&poses, requested, num_views)?;
    let context_poses: Vec<Pose> = frames.iter().map(|&frame| poses[frame]).collect();
    let normalization = PoseNormalization::find(key, &context_poses, &[], data.pose_rotation, data.pose_scale)
        .map_err(DataError::from)?;
    Ok((frames, normalization))
}

/// Checks the requested context frames, or chooses `num_views` frames along the camera path.
fn context_frames(poses: &[Pose], requested: Option<&[usize]>, num_views: usize) -> Result<Vec<usize>, SceneError> {
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

fn bad_config(key: &'static str, value: String, fix: String) -> SceneError {
    ModelError::BadConfig { key, value, fix }.into()
}

#[cfg(test)]
mod tests {
    use super::*;

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
