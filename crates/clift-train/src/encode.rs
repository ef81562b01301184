//! A capture to a scene: contexts, tokens, clusters, condenser.
// N encoder tokens, S stored tokens, D width

use clift_data::order::derive_seed;
use clift_data::{ClipReader, Pose, SceneFrame, ViewIndices, spread_along_path};
use clift_eval::{TokenCount, upload_views, view_cameras};
use clift_model::{Grouping, Scene, TokenKind, WorldFrame, total_variance, weights};

use crate::TrainError;
use crate::config::Config;
use crate::trained::Trained;

/// What is to be encoded.
#[derive(Clone, Debug, PartialEq)]
pub struct EncodeOptions {
    /// Frames the encoder sees; `None`: as many as in training, spread along the path.
    pub context: Option<Vec<usize>>,
    /// Number of stored tokens.
    pub storage: TokenCount,
    /// The model as the user typed it: noted in the scene.
    pub model_path: String,
}

/// A scene, and what it took.
#[derive(Clone, Debug)]
pub struct Encoded {
    /// The scene.
    pub scene: Scene,
    /// Tokens before clustering.
    pub num_lift_tokens: usize,
    /// Share of the tokens' variance that is left within clusters.
    pub cluster_error: f64,
}

impl Trained {
    /// Encodes a scene of `reader`. Clusters are those of `clift eval` for the same contexts and count.
    ///
    /// # Errors
    /// [`TrainError::BadConfig`] for contexts that the capture does not have, and the errors of reading and clustering.
    pub fn encode(
        &self,
        config: &Config,
        reader: &ClipReader,
        scene: usize,
        options: &EncodeOptions,
    ) -> Result<Encoded, TrainError> {
        if config.clusters.grouping != Grouping::Kmeans {
            let fix = "scenes are of K-means tokens: encode with a run whose clusters.grouping is \"kmeans\"".into();
            return Err(TrainError::BadConfig { key: "clusters.grouping".into(), value: "\"tile\"".into(), fix });
        }
        let key = reader.source.key(scene);
        let poses: Vec<Pose> = reader.source.cameras(scene)?.iter().map(|camera| camera.c2w).collect();
        let frames = context_frames(&poses, options.context.as_deref(), config.data.views.max_context)?;
        let context_poses: Vec<Pose> = frames.iter().map(|&frame| poses[frame]).collect();
        let views = ViewIndices { context: frames, target: Vec::new() };
        let clip = reader.read(scene, &views)?;
        let data = &config.data;
        let frame = SceneFrame::find(key, &context_poses, &[], data.pose_rotation, data.pose_scale)?;

        let lift = self.encoder.forward(&upload_views(&[&clip.context], &self.device)?); // [1, N, D]
        let lift = self.lift_norm.forward(lift);
        let [_, num_lift_tokens, dim] = lift.dims();
        let seed = derive_seed(derive_seed(config.seed, "eval"), key);
        let fit = config.clusters.kmeans.fit(lift.clone(), options.storage.of(num_lift_tokens)?, &[seed])?;
        let cluster_error = fit.error(0, total_variance(&lift)?[0]);
        let clusters = fit.clusters;
        let index = clusters.upload(&self.device);
        let (kind, tokens) = match &self.condenser {
            Some(condenser) => (TokenKind::Clift, condenser.forward(lift, &index)),
            None => (TokenKind::Kmeans, index.gather_centroids(lift)),
        };
        let tokens = tokens.into_data().convert::<f32>();
        let tokens = tokens.try_to_vec::<f32>().map_err(|error| TrainError::Tensor { reason: format!("{error:?}") })?;
        let token_ids = clusters.scenes()[0].centroid_index().to_vec();
        debug_assert_eq!(tokens.len(), token_ids.len() * dim, "a row per centroid");
        let scene = Scene {
            key: key.into(),
            kind,
            model: config.model.clone(),
            renderer_hash: weights::renderer_hash(&self.renderer, &config.model),
            model_path: options.model_path.clone(),
            height: data.height,
            width: data.width,
            context: view_cameras(&clip.context),
            context_frames: views.context.iter().map(|&frame| frame as u32).collect(),
            world: WorldFrame { mean_c2w: frame.mean_c2w.to_matrix_f64(), scale: frame.scale },
            token_ids,
            tokens,
        };
        Ok(Encoded { scene, num_lift_tokens, cluster_error })
    }
}

/// The frames asked for, or as many as in training, spread along the path.
fn context_frames(poses: &[Pose], asked: Option<&[usize]>, num_views: usize) -> Result<Vec<usize>, TrainError> {
    let num_frames = poses.len();
    let bad = |value: String, fix: String| TrainError::BadConfig { key: "--context".into(), value, fix };
    let Some(asked) = asked else {
        return spread_along_path(poses, num_views.min(num_frames)).ok_or_else(|| {
            bad(num_views.to_string(), format!("the scene has {num_frames} frames; name frames to use"))
        });
    };
    let list = asked.iter().map(ToString::to_string).collect::<Vec<_>>().join(",");
    let mut sorted = asked.to_vec();
    sorted.sort_unstable();
    sorted.dedup();
    if asked.len() < 2 || sorted.len() < asked.len() {
        return Err(bad(list, "write at least two frames, each once".into()));
    }
    if let Some(frame) = asked.iter().find(|frame| **frame >= num_frames) {
        let last = num_frames.saturating_sub(1);
        return Err(bad(list, format!("there is no frame {frame}; the scene has frames 0 to {last}")));
    }
    Ok(asked.to_vec())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn contexts_are_those_asked_for_or_spread_and_wrong_ones_are_named() {
        let at = |x: f64| Pose { translation: [x, 0.0, 0.0].into(), ..Pose::IDENTITY };
        let poses: Vec<Pose> = (0..10).map(f64::from).map(at).collect();
        assert_eq!(context_frames(&poses, None, 4).unwrap(), [0, 3, 6, 9]);
        assert_eq!(context_frames(&poses[..3], None, 4).unwrap(), [0, 1, 2]);
        assert_eq!(context_frames(&poses, Some(&[7, 2]), 4).unwrap(), [7, 2]);
        let message = |asked: &[usize]| context_frames(&poses, Some(asked), 4).unwrap_err().to_string();
        assert_eq!(message(&[0, 10]), "`--context` = 0,10: there is no frame 10; the scene has frames 0 to 9");
        assert_eq!(message(&[3, 3]), "`--context` = 3,3: write at least two frames, each once");
        assert_eq!(message(&[3]), "`--context` = 3: write at least two frames, each once");
    }
}
