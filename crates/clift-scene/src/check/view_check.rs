//! Checks of an encoded scene: renderings of frames that are not context views, and of the context views, beside the photos.

use clift_core::Camera;
use clift_data::{ClipReader, ViewIndices};
use clift_model::{SelectionPreset, TrainedModel, psnr};

use crate::check::baselines::{mean_image, nearest_image, view_image};
use crate::error::SceneError;
use crate::scene::scene::Scene;
use crate::scene::scene_renderer::SceneRenderer;

/// Largest number of times that frames are tried: images may be unreadable.
const MAX_TRIES: usize = 3;

/// PSNR of a context view, in dB, below which its rendering is fog: a capture whose photos are too far apart.
pub const MIN_CONTEXT_PSNR: f64 = 23.0;

/// A frame of the scene, rendered from the stored tokens.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CheckedView {
    /// The frame of the scene.
    pub frame: usize,
    /// PSNR of the rendering, in dB.
    pub psnr: f64,
    /// PSNR of a copy of the nearest context view, in dB; of a context view, that of the mean of all context images.
    pub baseline_psnr: f64,
}

impl CheckedView {
    /// Renders frames that are not context views: all that are `held_out`, or without any the frame farthest from the
    /// contexts, by number, between the first and the last; without one, the nearest beside them. `scene` was encoded by `model`
    /// from scene `index` of `reader`. Returns none if every frame is a context, or no other frame is readable.
    ///
    /// # Errors
    /// The errors of the model.
    pub fn other_frames(
        model: &TrainedModel,
        (reader, index): (&ClipReader, usize),
        scene: &Scene,
        held_out: &[usize],
    ) -> Result<Vec<Self>, SceneError> {
        let views = match held_out {
            [] => CheckViews::read(reader, index, scene, 1)?,
            _ => Some(CheckViews::of_frames(reader, index, scene, held_out)?),
        };
        views.map_or(Ok(Vec::new()), |views| views.render(model, scene, |view| &views.nearest[view]))
    }

    /// Renders the context views.
    ///
    /// # Errors
    /// Those of reading the images, and of the model.
    pub fn contexts(
        model: &TrainedModel,
        (reader, index): (&ClipReader, usize),
        scene: &Scene,
    ) -> Result<Vec<Self>, SceneError> {
        let views = CheckViews::contexts(reader, index, scene)?;
        views.render(model, scene, |_| &views.mean)
    }

    /// Whether the rendering of a context view is fog.
    pub fn is_fog(&self) -> bool {
        self.psnr < MIN_CONTEXT_PSNR || self.psnr < self.baseline_psnr
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
    /// Mean of the context images.
    pub mean: Vec<f32>,
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
            mean: mean_image(&clip.context)?,
        })
    }

    /// Compares renderings of the frames with the photos, and the photos with the `baseline` of each.
    fn render<'a>(
        &'a self,
        model: &TrainedModel,
        scene: &Scene,
        baseline: impl Fn(usize) -> &'a [f32],
    ) -> Result<Vec<CheckedView>, SceneError> {
        let rendered = render_scene(model, scene, &self.cameras, self.size)?;
        let views = rendered.iter().zip(self.truth.chunks_exact(self.size[0] * self.size[1] * 3)).enumerate();
        let view = |(view, (pixels, truth)): (usize, (&Vec<f32>, &[f32]))| {
            let baseline_psnr = psnr(baseline(view), truth)?;
            Ok(CheckedView { frame: self.frames[view], psnr: psnr(pixels, truth)?, baseline_psnr })
        };
        views.map(view).collect()
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
