//! Checks of an encoded scene: renderings of frames that are not context views, and of the context views, beside the photos.

use clift_core::{ClipViews, Pose};
use clift_data::ClipReader;
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
    /// Compares renderings of `views` with copies of the nearest of the `context` views.
    pub fn others(
        renderer: &mut SceneRenderer,
        views: &ClipViews,
        context: &ClipViews,
    ) -> Result<Vec<Self>, SceneError> {
        Self::compare(renderer, views, |c2w| nearest_image(context, c2w))
    }

    /// Compares renderings of the context views with the mean of their images.
    pub fn contexts(renderer: &mut SceneRenderer, context: &ClipViews) -> Result<Vec<Self>, SceneError> {
        let mean = mean_image(context)?;
        Self::compare(renderer, context, |_| Ok(mean.clone()))
    }

    fn compare(
        renderer: &mut SceneRenderer,
        views: &ClipViews,
        baseline: impl Fn(Pose) -> Result<Vec<f32>, SceneError>,
    ) -> Result<Vec<Self>, SceneError> {
        let rendered = render_views(renderer, views)?;
        let view = |(view, pixels): (usize, Vec<f32>)| {
            let truth = view_image(views, view);
            let baseline_psnr = psnr(&baseline(views.cameras[view].c2w)?, &truth)?;
            Ok(Self { frame: views.frame_index[view], psnr: psnr(&pixels, &truth)?, baseline_psnr })
        };
        rendered.into_iter().enumerate().map(view).collect()
    }

    /// Whether the rendering of a context view is fog.
    pub fn is_fog(&self) -> bool {
        self.psnr < MIN_CONTEXT_PSNR || self.psnr < self.baseline_psnr
    }
}

/// Reads up to `count` frames that are not context views, with the poses of the scene: of those between the contexts, the
/// farthest from a context first; without one, the nearest beside them. `None` if none is readable.
pub(crate) fn read_others(
    reader: &ClipReader,
    index: usize,
    scene: &Scene,
    count: usize,
) -> Result<Option<ClipViews>, SceneError> {
    let context: Vec<usize> = scene.context_frames.iter().map(|&frame| frame as usize).collect();
    let frames = candidates(&context, reader.source.num_frames(index)?);
    Ok(frames.chunks(count).take(MAX_TRIES).find_map(|frames| reader.read_views(index, frames, &scene.world).ok()))
}

/// Renders views from all tokens, `[height, width, 3]` each.
pub(crate) fn render_views(renderer: &mut SceneRenderer, views: &ClipViews) -> Result<Vec<Vec<f32>>, SceneError> {
    let rendered = renderer.render(&views.cameras, views.height, views.width, renderer.max_render_tokens())?;
    Ok(rendered.into_iter().map(|view| view.pixels).collect())
}

/// Copies the tokens of a scene to the device of its model.
pub(crate) fn scene_renderer(model: &TrainedModel, scene: &Scene) -> Result<SceneRenderer, SceneError> {
    let rules = SelectionPreset::Paper.rules();
    Ok(SceneRenderer::new(scene, model.network.renderer.clone(), rules, &model.device)?)
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
