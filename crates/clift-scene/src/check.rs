//! Checks of an encoded scene: renderings of frames that are not context views, and of the context views, beside the photos and
//! beside baselines: a copy of the nearest context view, and the mean of all.

use clift_core::{Camera, ClipViews, Pose};
use clift_data::ClipReader;
use clift_model::psnr;

use crate::error::SceneError;
use crate::scene::scene::{ContextGroup, Scene};
use crate::scene::scene_renderer::{RenderedView, SceneRenderer};

/// Tolerance of a tie, relative to the largest distance or in radians. Rounding must not decide between cameras that
/// rotate in place.
const TIE: f64 = 1e-9;

/// Finds the nearest camera centre. Ties go to the smaller rotation angle, then to the lower index.
pub fn nearest_view(context: &[Camera], target: Pose) -> Result<usize, SceneError> {
    let distances: Vec<f64> =
        context.iter().map(|camera| camera.c2w.translation.distance(target.translation)).collect();
    let nearest = distances.iter().copied().reduce(f64::min).ok_or(SceneError::NoContext)?;
    let tie = TIE * distances.iter().copied().fold(0.0, f64::max);
    let near: Vec<usize> = (0..distances.len()).filter(|&i| distances[i] <= nearest + tie).collect();
    let angles: Vec<f64> = near.iter().map(|&i| context[i].c2w.angle_to(target)).collect();
    let smallest = angles.iter().copied().fold(f64::INFINITY, f64::min);
    let first = angles.iter().position(|&angle| angle <= smallest + TIE).ok_or(SceneError::NoContext)?;
    Ok(near[first])
}

/// Returns the image of a view, `[height, width, 3]` in `[0, 1]`.
pub fn view_image(views: &ClipViews, view: usize) -> Vec<f32> {
    let len = views.height * views.width * 3;
    views.images[view * len..][..len].iter().map(|&value| f32::from(value) / 255.0).collect()
}

/// Returns the image of the nearest context view, `[height, width, 3]` in [0, 1].
pub fn nearest_image(context: &ClipViews, target: Pose) -> Result<Vec<f32>, SceneError> {
    Ok(view_image(context, nearest_view(&context.cameras, target)?))
}

/// Returns the mean of the context images, `[height, width, 3]` in [0, 1].
pub fn mean_image(context: &ClipViews) -> Result<Vec<f32>, SceneError> {
    if context.num_views() == 0 {
        return Err(SceneError::NoContext);
    }
    let mut sums = vec![0_u32; context.height * context.width * 3];
    for image in context.images.chunks_exact(sums.len()) {
        for (sum, &value) in sums.iter_mut().zip(image) {
            *sum += u32::from(value);
        }
    }
    let scale = 255.0 * context.num_views() as f64;
    Ok(sums.into_iter().map(|sum| (f64::from(sum) / scale) as f32).collect())
}

const MAX_CONTEXTS: usize = 16;
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
    /// Compares renderings of at most 16 context views, spread over all, with the mean of all images.
    pub fn contexts(renderer: &mut SceneRenderer, context: &ClipViews) -> Result<Vec<Self>, SceneError> {
        let mean = mean_image(context)?;
        let every = context.num_views().div_ceil(MAX_CONTEXTS);
        let views = (0..context.num_views() as u32).step_by(every).collect();
        let checked = ContextGroup { views, ..ContextGroup::of_all(0) }.members(context);
        Self::compare(renderer, &checked, |_| Ok(mean.clone()))
    }

    /// Compares renderings of `views` with the images that `baseline` has for their poses.
    pub(crate) fn compare(
        renderer: &mut SceneRenderer,
        views: &ClipViews,
        baseline: impl Fn(Pose) -> Result<Vec<f32>, SceneError>,
    ) -> Result<Vec<Self>, SceneError> {
        let rendered = renderer.render(&views.cameras, views.height, views.width, renderer.max_render_tokens())?;
        let view = |(view, rendered): (usize, RenderedView)| {
            let truth = view_image(views, view);
            let baseline_psnr = psnr(&baseline(views.cameras[view].c2w)?, &truth)?;
            Ok(Self { frame: views.frame_index[view], psnr: psnr(&rendered.pixels, &truth)?, baseline_psnr })
        };
        rendered.into_iter().enumerate().map(view).collect()
    }

    /// Whether the rendering of a context view is fog.
    pub fn is_fog(&self) -> bool {
        self.psnr < MIN_CONTEXT_PSNR || self.psnr < self.baseline_psnr
    }
}

/// Reads a frame that is not a context view, with the pose of the scene: of those between the contexts, the farthest from a
/// context; without one, the nearest beside them. `None` if none is readable.
pub(crate) fn read_other(reader: &ClipReader, index: usize, scene: &Scene) -> Result<Option<ClipViews>, SceneError> {
    let context: Vec<usize> = scene.context_frames.iter().map(|&frame| frame as usize).collect();
    let frames = candidates(&context, reader.source.num_frames(index)?);
    Ok(frames.iter().take(MAX_TRIES).find_map(|&frame| reader.read_views(index, &[frame], &scene.world).ok()))
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
    use clift_core::{DMat3, DVec3, Intrinsics};

    use super::*;

    fn pose(x: f64, yaw_deg: f64) -> Pose {
        Pose { rotation: DMat3::from_rotation_y(yaw_deg.to_radians()), translation: x * DVec3::X }
    }

    fn views(poses: &[Pose], images: Vec<u8>) -> ClipViews {
        let intrinsics = Intrinsics { fx: 16.0, fy: 16.0, cx: 8.0, cy: 8.0 };
        let cameras = poses.iter().map(|&c2w| Camera { c2w, intrinsics }).collect();
        ClipViews { width: 1, height: 1, images, cameras, frame_index: (0..poses.len()).collect() }
    }

    #[test]
    fn distance_decides_then_angle_then_index() {
        for (context, target, expected, case) in [
            ([pose(1.0, 0.0), pose(0.5, 90.0)], pose(0.0, 0.0), 1, "distance before angle"),
            ([pose(1.0, 40.0), pose(-1.0, 5.0)], pose(0.0, 10.0), 1, "angle at equal distance"),
            ([pose(1.0, 5e-7), pose(-1.0, 0.0)], pose(0.0, 0.0), 1, "angle of 1e-8, which a cosine does not show"),
            ([pose(1.0, 20.0), pose(-1.0, 0.0)], pose(0.0, 10.0), 0, "index at equal angle"),
            ([pose(1.0 - 1e-14, 90.0), pose(1.0, 1.0)], pose(0.0, 0.0), 1, "a rounding difference is a tie"),
        ] {
            assert_eq!(nearest_view(&views(&context, Vec::new()).cameras, target).unwrap(), expected, "{case}");
        }
    }

    #[test]
    fn baseline_images_are_the_mean_and_a_copy() {
        let context = views(&[pose(0.0, 0.0), pose(1.0, 0.0)], vec![0, 51, 255, 255, 102, 255]);
        assert_eq!(mean_image(&context).unwrap(), [0.5, 0.3, 1.0]);
        assert_eq!(nearest_image(&context, pose(0.9, 0.0)).unwrap(), [1.0, 0.4, 1.0]);
        let empty = views(&[], Vec::new());
        assert!(matches!(mean_image(&empty), Err(SceneError::NoContext)));
        assert!(matches!(nearest_image(&empty, Pose::IDENTITY), Err(SceneError::NoContext)));
    }

    #[test]
    fn frames_between_contexts_come_first() {
        assert_eq!(candidates(&[2, 8, 4], 12), [6, 3, 5, 7, 1, 9, 0, 10, 11]);
        assert_eq!(candidates(&[0, 1], 2), [0; 0]);
    }
}
