//! A check of an encoded scene: a frame that is not a context view, rendered and compared with the nearest context view.

use clift_core::Camera;
use clift_data::{ClipReader, ViewIndices};
use clift_model::{SelectionPreset, TrainedModel, psnr};

use crate::check::baselines::{nearest_image, view_image};
use crate::error::SceneError;
use crate::scene::scene::Scene;
use crate::scene::scene_renderer::SceneRenderer;

/// Largest number of frames that are tried: images may be unreadable.
const MAX_TRIES: usize = 3;

/// A frame that is not a context view, rendered from the stored tokens.
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
    /// Renders the frame farthest from the contexts, by number, between the first and the last context; without one, the
    /// nearest beside them. `scene` was encoded by `model` from scene `index` of `reader`. Returns `None` if every frame is a
    /// context, or no other frame is readable.
    ///
    /// # Errors
    /// The errors of the model.
    pub fn render(
        model: &TrainedModel,
        reader: &ClipReader,
        index: usize,
        scene: &Scene,
    ) -> Result<Option<Self>, SceneError> {
        let Some(CheckViews { frames, cameras, truth, size, nearest }) = CheckViews::read(reader, index, scene, 1)?
        else {
            return Ok(None);
        };
        let pixels = render_scene(model, scene, &cameras, size)?.concat();
        let nearest_psnr = psnr(&nearest[0], &truth)?;
        Ok(Some(Self { frame: frames[0], psnr: psnr(&pixels, &truth)?, nearest_psnr }))
    }
}

/// Frames of a scene with true images, in the poses of its file.
pub(crate) struct CheckViews {
    pub frames: Vec<usize>,
    pub cameras: Vec<Camera>,
    /// RGB in `[0, 1]` of all frames, `[V, height, width, 3]`.
    pub truth: Vec<f32>,
    /// Height and width.
    pub size: [usize; 2],
    /// The context view nearest to every frame.
    pub nearest: Vec<Vec<f32>>,
}

impl CheckViews {
    /// Reads up to `count` frames that are not context views, the first [`candidates`]; `None` if none is readable.
    pub fn read(reader: &ClipReader, index: usize, scene: &Scene, count: usize) -> Result<Option<Self>, SceneError> {
        let context: Vec<usize> = scene.context_frames.iter().map(|&frame| frame as usize).collect();
        let frames = candidates(&context, reader.source.cameras(index)?.len());
        for frames in frames.chunks(count).take(MAX_TRIES) {
            if let Ok(views) = Self::of_frames(reader, index, scene, frames) {
                return Ok(Some(views));
            }
        }
        Ok(None)
    }

    /// Reads the contexts.
    pub fn contexts(reader: &ClipReader, index: usize, scene: &Scene) -> Result<Self, SceneError> {
        let context: Vec<usize> = scene.context_frames.iter().map(|&frame| frame as usize).collect();
        Self::of_frames(reader, index, scene, &context)
    }

    fn of_frames(reader: &ClipReader, index: usize, scene: &Scene, frames: &[usize]) -> Result<Self, SceneError> {
        let context: Vec<usize> = scene.context_frames.iter().map(|&frame| frame as usize).collect();
        let cameras = reader.source.cameras(index)?;
        let mut clip = reader.read(index, &ViewIndices { context, target: frames.to_vec() })?;
        // The poses of the scene file: `reader` may normalize by the target too.
        for views in [&mut clip.context, &mut clip.target] {
            for (camera, &frame) in views.cameras.iter_mut().zip(&views.frame_index) {
                camera.c2w = scene.world.normalize(cameras[frame].c2w);
            }
        }
        let nearest: Result<Vec<_>, _> =
            clip.target.cameras.iter().map(|camera| nearest_image(&clip.context, camera.c2w)).collect();
        Ok(Self {
            frames: frames.to_vec(),
            truth: (0..frames.len()).flat_map(|view| view_image(&clip.target, view)).collect(),
            size: [clip.target.height, clip.target.width],
            cameras: clip.target.cameras,
            nearest: nearest?,
        })
    }
}

/// Renders views of a scene from all its tokens, `[height, width, 3]` each.
pub(crate) fn render_scene(
    model: &TrainedModel,
    scene: &Scene,
    views: &[Camera],
    [height, width]: [usize; 2],
) -> Result<Vec<Vec<f32>>, SceneError> {
    let rules = SelectionPreset::Paper.rules();
    let mut renderer = SceneRenderer::new(scene, model.network.renderer.clone(), rules, &model.device)?;
    let rendered = renderer.render(views, height, width, scene.num_tokens())?;
    Ok(rendered.into_iter().map(|view| view.pixels).collect())
}

/// Returns the frames that are not context views: those between the contexts, the farthest from a context first, then the others,
/// the nearest first.
fn candidates(context: &[usize], num_frames: usize) -> Vec<usize> {
    let mut frames: Vec<usize> = (0..num_frames).filter(|frame| !context.contains(frame)).collect();
    let is_outside = |frame: usize| context.iter().all(|&c| c < frame) || context.iter().all(|&c| c > frame);
    let distance = |frame: usize| context.iter().map(|&c| c.abs_diff(frame)).min().unwrap_or_default();
    let key = |frame| if is_outside(frame) { (true, distance(frame)) } else { (false, num_frames - distance(frame)) };
    frames.sort_by_key(|&frame| key(frame));
    frames
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_between_contexts_come_first() {
        assert_eq!(candidates(&[2, 8, 4], 12), [6, 3, 5, 7, 1, 9, 0, 10, 11]);
        assert_eq!(candidates(&[0, 1], 2), [0; 0]);
    }
}
