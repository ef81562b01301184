//! Data sources for tests.

use std::sync::Arc;

use crate::error::DataError;
use crate::geometry::camera::Camera;
use crate::image::rgb_image::RgbImage;
use crate::scene_source::SceneSource;

type ChangeCameras = dyn Fn(usize, Vec<Camera>) -> Result<Vec<Camera>, DataError> + Send + Sync;
type ChangeFrame = dyn Fn(usize, usize, RgbImage) -> Result<RgbImage, DataError> + Send + Sync;
type EncodedFrame = dyn Fn(usize, usize) -> Option<Vec<u8>> + Send + Sync;

/// A source that passes the cameras and frames of another source through functions of a test.
pub struct TestSource {
    base: Arc<dyn SceneSource>,
    cameras: Box<ChangeCameras>,
    frame: Box<ChangeFrame>,
    encoded_frame: Box<EncodedFrame>,
}

impl TestSource {
    /// Wraps `base` without changes.
    pub fn new(base: impl SceneSource + 'static) -> Self {
        Self {
            base: Arc::new(base),
            cameras: Box::new(|_, cameras| Ok(cameras)),
            frame: Box::new(|_, _, frame| Ok(frame)),
            encoded_frame: Box::new(|_, _| None),
        }
    }

    /// Sets the function that changes the cameras of a scene.
    pub fn with_cameras(
        self,
        change: impl Fn(usize, Vec<Camera>) -> Result<Vec<Camera>, DataError> + Send + Sync + 'static,
    ) -> Self {
        Self { cameras: Box::new(change), ..self }
    }

    /// Sets the function that changes a frame.
    pub fn with_frames(
        self,
        change: impl Fn(usize, usize, RgbImage) -> Result<RgbImage, DataError> + Send + Sync + 'static,
    ) -> Self {
        Self { frame: Box::new(change), ..self }
    }

    /// Makes every frame of the scenes with `is_torn` fail.
    pub fn with_torn_frames(self, is_torn: impl Fn(usize) -> bool + Send + Sync + 'static) -> Self {
        self.with_frames(move |scene, frame, decoded| {
            let torn = || DataError::BadImage { key: scene.to_string(), frame, what: "it is torn".into() };
            if is_torn(scene) { Err(torn()) } else { Ok(decoded) }
        })
    }

    /// Sets the function that returns image files.
    pub fn with_encoded_frames(
        self,
        encoded_frame: impl Fn(usize, usize) -> Option<Vec<u8>> + Send + Sync + 'static,
    ) -> Self {
        Self { encoded_frame: Box::new(encoded_frame), ..self }
    }
}

impl SceneSource for TestSource {
    fn num_scenes(&self) -> usize {
        self.base.num_scenes()
    }
    fn key(&self, scene: usize) -> &str {
        self.base.key(scene)
    }
    fn find(&self, key: &str) -> Option<usize> {
        self.base.find(key)
    }
    fn cameras(&self, scene: usize) -> Result<Vec<Camera>, DataError> {
        (self.cameras)(scene, self.base.cameras(scene)?)
    }
    fn frame(&self, scene: usize, frame: usize) -> Result<RgbImage, DataError> {
        (self.frame)(scene, frame, self.base.frame(scene, frame)?)
    }
    fn encoded_frame(&self, scene: usize, frame: usize) -> Result<Option<Vec<u8>>, DataError> {
        Ok((self.encoded_frame)(scene, frame))
    }
}

/// Scenes with given numbers of frames, without cameras and images.
pub struct Lengths {
    lengths: Vec<usize>,
    pub keys: Vec<String>,
}

impl Lengths {
    pub fn new(lengths: Vec<usize>) -> Self {
        let keys = (0..lengths.len()).map(|scene| format!("scene-{scene}")).collect();
        Self { lengths, keys }
    }
}

impl SceneSource for Lengths {
    fn num_scenes(&self) -> usize {
        self.lengths.len()
    }
    fn key(&self, scene: usize) -> &str {
        &self.keys[scene]
    }
    fn find(&self, key: &str) -> Option<usize> {
        self.keys.iter().position(|other| other == key)
    }
    fn cameras(&self, scene: usize) -> Result<Vec<Camera>, DataError> {
        panic!("sampling views reads the cameras of scene {scene}, and reading the clip would again")
    }
    fn num_frames(&self, scene: usize) -> Result<usize, DataError> {
        Ok(self.lengths[scene])
    }
    fn frame(&self, scene: usize, frame: usize) -> Result<RgbImage, DataError> {
        Err(DataError::NoSuchFrame { key: self.keys[scene].clone(), frame, num_frames: self.lengths[scene] })
    }
}
