//! The training frames of a data set without a test split: every n-th frame of a scene is held out.

use std::sync::Arc;

use crate::error::DataError;
use crate::geometry::camera::Camera;
use crate::image::rgb_image::RgbImage;
use crate::scene_source::SceneSource;

/// Returns whether a frame is held out of training: frames 0, `every`, 2 `every`, .., as in the practice of `NeRF`.
/// With 0 no frame is.
pub fn is_held_out(frame: usize, every: usize) -> bool {
    every > 0 && frame.is_multiple_of(every)
}

/// The scenes of a source without their held-out frames ([`is_held_out`]); the other frames are renumbered.
pub(crate) struct TrainingFrames {
    source: Arc<dyn SceneSource>,
    every: usize,
}

impl TrainingFrames {
    /// Holds out every `every`-th frame; `every` is at least 2.
    pub fn new(source: Arc<dyn SceneSource>, every: usize) -> Self {
        Self { source, every }
    }

    /// Returns the number of a training frame in the source.
    fn in_source(&self, frame: usize) -> usize {
        frame + 1 + frame / (self.every - 1)
    }

    fn kept<T>(&self, values: Vec<T>) -> Vec<T> {
        let kept = values.into_iter().enumerate().filter(|(frame, _)| !is_held_out(*frame, self.every));
        kept.map(|(_, value)| value).collect()
    }
}

impl SceneSource for TrainingFrames {
    fn num_scenes(&self) -> usize {
        self.source.num_scenes()
    }

    fn key(&self, scene: usize) -> &str {
        self.source.key(scene)
    }

    fn find(&self, key: &str) -> Option<usize> {
        self.source.find(key)
    }

    fn cameras(&self, scene: usize) -> Result<Vec<Camera>, DataError> {
        Ok(self.kept(self.source.cameras(scene)?))
    }

    fn num_frames(&self, scene: usize) -> Result<usize, DataError> {
        let num_frames = self.source.num_frames(scene)?;
        Ok(num_frames - num_frames.div_ceil(self.every))
    }

    fn timestamps(&self, scene: usize) -> Result<Vec<i64>, DataError> {
        Ok(self.kept(self.source.timestamps(scene)?))
    }

    fn url(&self, scene: usize) -> Result<String, DataError> {
        self.source.url(scene)
    }

    fn frame_names(&self, scene: usize) -> Result<Vec<String>, DataError> {
        Ok(self.kept(self.source.frame_names(scene)?))
    }

    fn image_size(&self, scene: usize, frame: usize) -> Result<[usize; 2], DataError> {
        self.source.image_size(scene, self.in_source(frame))
    }

    fn frame(&self, scene: usize, frame: usize) -> Result<RgbImage, DataError> {
        self.source.frame(scene, self.in_source(frame))
    }

    fn encoded_frame(&self, scene: usize, frame: usize) -> Result<Option<Vec<u8>>, DataError> {
        self.source.encoded_frame(scene, self.in_source(frame))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::config::SyntheticConfig;
    use crate::synthetic::source::SyntheticSource;

    #[test]
    fn training_has_all_frames_but_the_held_out() {
        for (every, num_frames) in [(2, 7), (3, 9), (8, 16), (8, 17), (8, 3)] {
            let whole = Arc::new(SyntheticSource::new(SyntheticConfig { num_frames, ..Default::default() }).unwrap());
            let training = TrainingFrames::new(whole.clone(), every);
            let expected: Vec<usize> = (0..num_frames).filter(|frame| frame % every != 0).collect();
            assert_eq!(training.num_frames(0).unwrap(), expected.len());
            let cameras = whole.cameras(0).unwrap();
            assert_eq!(training.cameras(0).unwrap(), expected.iter().map(|&i| cameras[i]).collect::<Vec<_>>());
            for (frame, &in_source) in expected.iter().enumerate() {
                assert_eq!(training.in_source(frame), in_source);
                assert_eq!(training.frame(0, frame).unwrap(), whole.frame(0, in_source).unwrap());
            }
        }
        assert!(!is_held_out(0, 0) && is_held_out(0, 8) && is_held_out(16, 8) && !is_held_out(15, 8));
    }
}
