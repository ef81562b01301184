//! A check of an encoded scene: a frame that is no context, rendered and compared with the nearest context view.

use burn::tensor::{Tensor, TensorData};
use clift_data::{ClipReader, Pose, PoseNormalization, ViewIndices};
use clift_model::{Scene, SceneModel, TrainedModel};

use crate::error::EvalError;
use crate::metrics::image_metrics::psnr;
use crate::sweep::baselines::{nearest_image, view_image};
use crate::upload::upload_cameras;

/// Largest number of frames that are tried: images may be unreadable.
const MAX_TRIES: usize = 3;

/// A frame that is no context, rendered from the stored tokens.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HeldOutFrame {
    /// The frame of the scene.
    pub frame: usize,
    /// PSNR of the rendering, in dB.
    pub psnr: f64,
    /// PSNR of a copy of the nearest context view, in dB.
    pub nearest_psnr: f64,
}

impl HeldOutFrame {
    /// Renders the frame farthest from the contexts, by number, between the first and the last context. `scene` was encoded
    /// by `model` from scene `index` of `reader`. Returns `None` if every frame is a context, or no other frame is readable.
    ///
    /// # Errors
    /// The errors of the model.
    pub fn render(
        model: &TrainedModel,
        reader: &ClipReader,
        index: usize,
        scene: &Scene,
    ) -> Result<Option<Self>, EvalError> {
        let context: Vec<usize> = scene.context_frames.iter().map(|&frame| frame as usize).collect();
        let cameras = reader.source.cameras(index)?;
        let normalization =
            PoseNormalization { mean_c2w: Pose::from_matrix(&scene.world.mean_c2w)?, scale: scene.world.scale };
        for frame in candidates(&context, cameras.len()).into_iter().take(MAX_TRIES) {
            let Ok(mut clip) = reader.read(index, &ViewIndices { context: context.clone(), target: vec![frame] })
            else {
                continue;
            };
            // The poses of the scene file: `reader` may normalize by the target too.
            for views in [&mut clip.context, &mut clip.target] {
                views.c2w = views.frame_index.iter().map(|&i| normalization.normalize(cameras[i].c2w)).collect();
            }
            let shape = [1, scene.num_tokens(), scene.tokens.len() / scene.num_tokens().max(1)];
            let tokens: Tensor<3> = Tensor::from_data(TensorData::new(scene.tokens.clone(), shape), &model.device);
            let image = model.network.render(tokens, &upload_cameras(&[&clip.target], &model.device)?);
            let pixels = image.into_data().convert::<f32>().try_to_vec::<f32>().map_err(EvalError::tensor)?;
            let target = view_image(&clip.target, 0);
            let nearest = nearest_image(&clip.context, clip.target.c2w[0])?;
            let nearest_psnr = psnr(&nearest, &target)?;
            return Ok(Some(Self { frame, psnr: psnr(&pixels, &target)?, nearest_psnr }));
        }
        Ok(None)
    }
}

/// Returns the frames that are no contexts: those between the contexts first, the farthest from a context first.
fn candidates(context: &[usize], num_frames: usize) -> Vec<usize> {
    let mut frames: Vec<usize> = (0..num_frames).filter(|frame| !context.contains(frame)).collect();
    let is_outside = |frame: usize| context.iter().all(|&c| c < frame) || context.iter().all(|&c| c > frame);
    let distance = |frame: usize| context.iter().map(|&c| c.abs_diff(frame)).min().unwrap_or_default();
    frames.sort_by_key(|&frame| (is_outside(frame), std::cmp::Reverse(distance(frame))));
    frames
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_between_contexts_come_first() {
        assert_eq!(candidates(&[2, 8, 4], 12), [6, 3, 5, 7, 11, 0, 10, 1, 9]);
        assert_eq!(candidates(&[0, 1], 2), [0; 0]);
    }
}
