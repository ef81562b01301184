//! A subset of the scenes of a source.

use std::collections::HashMap;
use std::sync::Arc;

use crate::error::DataError;
use crate::geometry::camera::Camera;
use crate::image::rgb_image::RgbImage;
use crate::scene_source::SceneSource;

/// A subset of the scenes of a source, in the given order.
pub struct SceneSubset {
    source: Arc<dyn SceneSource>,
    /// Indices in `source`.
    scenes: Vec<usize>,
    /// Indices in this subset by those in `source`.
    positions: HashMap<usize, usize>,
}

impl SceneSubset {
    /// Keeps the scenes with these indices, which must exist in the source.
    pub fn new(source: Arc<dyn SceneSource>, scenes: Vec<usize>) -> Self {
        let positions = scenes.iter().enumerate().map(|(position, scene)| (*scene, position)).collect();
        Self { source, scenes, positions }
    }

    /// Keeps at most the first `num_scenes` scenes.
    pub fn first(source: Arc<dyn SceneSource>, num_scenes: usize) -> Self {
        let scenes = (0..num_scenes.min(source.num_scenes())).collect();
        Self::new(source, scenes)
    }
}

impl SceneSource for SceneSubset {
    fn num_scenes(&self) -> usize {
        self.scenes.len()
    }

    fn key(&self, scene: usize) -> &str {
        self.source.key(self.scenes[scene])
    }

    fn find(&self, key: &str) -> Option<usize> {
        self.positions.get(&self.source.find(key)?).copied()
    }

    fn num_frames(&self, scene: usize) -> Result<usize, DataError> {
        self.source.num_frames(self.scenes[scene])
    }

    fn cameras(&self, scene: usize) -> Result<Vec<Camera>, DataError> {
        self.source.cameras(self.scenes[scene])
    }

    fn timestamps(&self, scene: usize) -> Result<Vec<i64>, DataError> {
        self.source.timestamps(self.scenes[scene])
    }

    fn url(&self, scene: usize) -> Result<String, DataError> {
        self.source.url(self.scenes[scene])
    }

    fn frame_names(&self, scene: usize) -> Result<Vec<String>, DataError> {
        self.source.frame_names(self.scenes[scene])
    }

    fn image_size(&self, scene: usize, frame: usize) -> Result<[usize; 2], DataError> {
        self.source.image_size(self.scenes[scene], frame)
    }

    fn frame(&self, scene: usize, frame: usize) -> Result<RgbImage, DataError> {
        self.source.frame(self.scenes[scene], frame)
    }

    fn encoded_frame(&self, scene: usize, frame: usize) -> Result<Option<Vec<u8>>, DataError> {
        self.source.encoded_frame(self.scenes[scene], frame)
    }
}
