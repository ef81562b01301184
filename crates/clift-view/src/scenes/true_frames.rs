//! Frames of a run's scene that have a true image and are not context views.

use clift_core::{Camera, ClipViews, Pose};
use clift_data::{ClipReader, ViewIndices};
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
    let context = scene.context_frames.iter().map(|&frame| frame as usize).collect();
    let mut target = reader.read(index, &ViewIndices { context, target: vec![frame.frame] })?.target;
    // The pose of the scene file: `reader` may normalize by the target too.
    target.cameras[0].c2w = frame.c2w;
    Ok(TrueImage { image: images(&target)?.remove(0), camera: target.cameras[0] })
}

/// Reads the context images.
pub fn read_context(reader: &ClipReader, index: usize, scene: &Scene) -> Result<Vec<Canvas>, ViewError> {
    let context = scene.context_frames.iter().map(|&frame| frame as usize).collect();
    images(&reader.read(index, &ViewIndices { context, target: Vec::new() })?.context)
}

fn images(views: &ClipViews) -> Result<Vec<Canvas>, ViewError> {
    let images = views.images.chunks_exact(views.height * views.width * 3);
    images.map(|rgb| Ok(Canvas::from_rgb8(rgb, views.height, views.width)?)).collect()
}
