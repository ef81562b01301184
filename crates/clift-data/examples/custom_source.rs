//! A data source of one's own: implement [`SceneSource`], then read clips from it like from any other source.
//!
//! The source serves one scene: a camera that moves sideways in front of a coloured wall. A real source reads cameras
//! and images from its own files in the same five methods.
//!
//! ```text
//! cargo run --release -p clift-data --example custom_source
//! ```

use std::sync::Arc;

use clift_core::{Camera, DVec3, IntrinsicsNorm, Pose, RgbImage};
use clift_data::{ClipOptions, ClipReader, DataError, SceneSource, ViewIndices};

struct Wall;

impl SceneSource for Wall {
    fn num_scenes(&self) -> usize {
        1
    }

    fn key(&self, _scene: usize) -> &'static str {
        "wall"
    }

    fn find(&self, key: &str) -> Option<usize> {
        (key == "wall").then_some(0)
    }

    /// Poses are camera to world, OpenCV axes. Intrinsics are relative to the width and height of the image.
    fn cameras(&self, _scene: usize) -> Result<Vec<Camera<IntrinsicsNorm>>, DataError> {
        let intrinsics_norm = IntrinsicsNorm { fx: 0.5, fy: 0.5, cx: 0.5, cy: 0.5 };
        let c2w = |frame: u32| Pose { translation: 0.1 * f64::from(frame) * DVec3::X, ..Pose::IDENTITY };
        Ok((0..8).map(|frame| Camera { intrinsics: intrinsics_norm, c2w: c2w(frame) }).collect())
    }

    fn frame(&self, _scene: usize, frame: usize) -> Result<RgbImage, DataError> {
        let pixels = (0..64 * 64).flat_map(|pixel| [(4 * (pixel % 64)) as u8, (4 * (pixel / 64)) as u8, frame as u8]);
        Ok(RgbImage { width: 64, height: 64, rgb: pixels.collect() })
    }
}

fn main() -> Result<(), DataError> {
    let options = ClipOptions { width: 32, height: 32, ..ClipOptions::default() };
    let reader = ClipReader { source: Arc::new(Wall), options };
    let clip = reader.read(0, &ViewIndices { context: vec![0, 3, 7], target: vec![5] })?;
    println!("{}: {} context views, {} target view", clip.key, clip.context.num_views(), clip.target.num_views());
    Ok(())
}
