//! Frames of a run's scene that have a true image and are not context views.

use clift_core::{Camera, ClipViews, Pose};
use clift_data::ClipReader;
use clift_eval::Canvas;
use clift_scene::Scene;

use crate::error::ViewError;

/// Most frames of a scene in the page's list, spread evenly.
const MAX_FRAMES: usize = 256;

/// A frame of the scene, and its camera in the normalized frame without reading the image.
#[derive(Clone, Copy, Debug)]
pub struct TrueFrame {
    pub frame: usize,
    pub c2w: Pose,
}

/// A true image and its camera.
#[derive(Clone, Debug)]
pub struct TrueImage {
    pub image: Canvas,
    pub camera: Camera,
}

/// Lists the frames that are not context views.
pub fn list(reader: &ClipReader, index: usize, scene: &Scene) -> Result<Vec<TrueFrame>, ViewError> {
    let cameras = reader.source.cameras(index)?;
    let is_context = |frame: usize| scene.context_frames.contains(&(frame as u32));
    let others = cameras.iter().enumerate().filter(|(frame, _)| !is_context(*frame));
    let frames: Vec<TrueFrame> =
        others.map(|(frame, camera)| TrueFrame { frame, c2w: scene.world.normalize(camera.c2w) }).collect();
    Ok(frames.iter().step_by(frames.len().div_ceil(MAX_FRAMES).max(1)).copied().collect())
}

/// Reads a frame at the size of the context views.
pub fn read(reader: &ClipReader, index: usize, scene: &Scene, frame: TrueFrame) -> Result<TrueImage, ViewError> {
    let views = reader.read_views(index, &[frame.frame], &scene.world)?;
    Ok(TrueImage { image: images(&views)?.remove(0), camera: views.cameras[0] })
}

/// Returns the images of views.
pub fn images(views: &ClipViews) -> Result<Vec<Canvas>, ViewError> {
    let images = views.images.chunks_exact(views.height * views.width * 3);
    images.map(|rgb| Ok(Canvas::from_rgb8(rgb, views.height, views.width)?)).collect()
}
