//! Some of the scenes of a source, or some of their frames.

use std::collections::HashMap;
use std::sync::Arc;

use clift_core::{Camera, IntrinsicsNorm, RgbImage};

use crate::error::DataError;
use crate::scene_source::SceneSource;

/// Some scenes of a source in the given order, with all frames or those of training.
pub struct SceneSubset {
    source: Arc<dyn SceneSource>,
    /// Indices in `source`.
    scenes: Vec<usize>,
    /// Indices in this subset by those in `source`.
    positions: HashMap<usize, usize>,
    /// The frames of [`SceneSource::held_out`] of this number are left out; the other frames are renumbered.
    hold_out: usize,
}

impl SceneSubset {
    /// Keeps the scenes with these indices, which must exist in the source.
    pub fn new(source: Arc<dyn SceneSource>, scenes: Vec<usize>) -> Self {
        let positions = scenes.iter().enumerate().map(|(position, scene)| (*scene, position)).collect();
        Self { source, scenes, positions, hold_out: 0 }
    }

    /// Keeps at most the first `num_scenes` scenes.
    pub fn first(source: Arc<dyn SceneSource>, num_scenes: usize) -> Self {
        let scenes = (0..num_scenes.min(source.num_scenes())).collect();
        Self::new(source, scenes)
    }

    /// Keeps all scenes without their held-out frames.
    pub(crate) fn without_held_out(source: Arc<dyn SceneSource>, hold_out: usize) -> Self {
        Self { hold_out, ..Self::first(source, usize::MAX) }
    }

    /// Returns the frames in the source of a scene of this subset.
    fn kept_frames(&self, scene: usize) -> Result<Vec<usize>, DataError> {
        let scene = self.scenes[scene];
        let held_out = self.source.held_out(scene, self.hold_out)?;
        Ok((0..self.source.num_frames(scene)?).filter(|frame| held_out.binary_search(frame).is_err()).collect())
    }

    /// Returns the number of a kept frame in the source.
    fn frame_in_source(&self, scene: usize, frame: usize) -> Result<usize, DataError> {
        if self.hold_out == 0 {
            return Ok(frame);
        }
        let kept = self.kept_frames(scene)?;
        let (key, num_frames) = (self.key(scene), kept.len());
        kept.get(frame).copied().ok_or_else(|| DataError::NoSuchFrame { key: key.to_owned(), frame, num_frames })
    }

    /// Keeps the values of the kept frames, of values for the frames in the source.
    fn kept<T>(&self, scene: usize, values: Vec<T>) -> Result<Vec<T>, DataError> {
        if self.hold_out == 0 {
            return Ok(values);
        }
        let held_out = self.source.held_out(self.scenes[scene], self.hold_out)?;
        let kept = values.into_iter().enumerate().filter(|(frame, _)| held_out.binary_search(frame).is_err());
        Ok(kept.map(|(_, value)| value).collect())
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
        let scene = self.scenes[scene];
        Ok(self.source.num_frames(scene)? - self.source.held_out(scene, self.hold_out)?.len())
    }

    fn cameras(&self, scene: usize) -> Result<Vec<Camera<IntrinsicsNorm>>, DataError> {
        self.kept(scene, self.source.cameras(self.scenes[scene])?)
    }

    fn timestamps(&self, scene: usize) -> Result<Vec<i64>, DataError> {
        self.kept(scene, self.source.timestamps(self.scenes[scene])?)
    }

    fn url(&self, scene: usize) -> Result<String, DataError> {
        self.source.url(self.scenes[scene])
    }

    fn frame_names(&self, scene: usize) -> Result<Vec<String>, DataError> {
        self.kept(scene, self.source.frame_names(self.scenes[scene])?)
    }

    fn held_out(&self, scene: usize, every: usize) -> Result<Vec<usize>, DataError> {
        if self.hold_out == 0 { self.source.held_out(self.scenes[scene], every) } else { Ok(Vec::new()) }
    }

    fn image_size(&self, scene: usize, frame: usize) -> Result<[usize; 2], DataError> {
        self.source.image_size(self.scenes[scene], self.frame_in_source(scene, frame)?)
    }

    fn frame(&self, scene: usize, frame: usize) -> Result<RgbImage, DataError> {
        self.source.frame(self.scenes[scene], self.frame_in_source(scene, frame)?)
    }

    fn frame_with_coverage(&self, scene: usize, frame: usize) -> Result<(RgbImage, Option<RgbImage>), DataError> {
        self.source.frame_with_coverage(self.scenes[scene], self.frame_in_source(scene, frame)?)
    }

    fn encoded_frame(&self, scene: usize, frame: usize) -> Result<Option<Vec<u8>>, DataError> {
        self.source.encoded_frame(self.scenes[scene], self.frame_in_source(scene, frame)?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene_source::is_held_out;
    use crate::testing::rooms;

    #[test]
    fn training_has_all_frames_but_the_held_out() {
        for (every, num_frames) in [(2, 7), (3, 9), (8, 16), (8, 17), (8, 3)] {
            let whole = Arc::new(rooms(|c| c.num_frames = num_frames));
            let training = SceneSubset::without_held_out(whole.clone(), every);
            let expected: Vec<usize> = (0..num_frames).filter(|frame| frame % every != 0).collect();
            assert_eq!(training.num_frames(0).unwrap(), expected.len());
            let cameras = whole.cameras(0).unwrap();
            assert_eq!(training.cameras(0).unwrap(), expected.iter().map(|&i| cameras[i]).collect::<Vec<_>>());
            for (frame, &in_source) in expected.iter().enumerate() {
                assert_eq!(training.frame_in_source(0, frame).unwrap(), in_source);
                assert_eq!(training.frame(0, frame).unwrap(), whole.frame(0, in_source).unwrap());
            }
        }
        assert!(!is_held_out(0, 0) && is_held_out(0, 8) && is_held_out(16, 8) && !is_held_out(15, 8));
    }
}
