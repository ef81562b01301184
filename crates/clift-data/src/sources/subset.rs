//! Some of the scenes of a source, or some of their frames.

use std::collections::HashMap;
use std::sync::Arc;

use clift_core::{Camera, IntrinsicsNorm, RgbImage};
use rayon::prelude::*;

use crate::error::DataError;
use crate::scene_source::SceneSource;

/// Some scenes of a source in the given order, with all frames or those of training.
pub struct SceneSubset {
    source: Arc<dyn SceneSource>,
    /// Indices in `source`.
    scenes: Vec<usize>,
    /// Indices in this subset by those in `source`.
    positions: HashMap<usize, usize>,
    /// The other frames are renumbered.
    left_out: LeftOut,
}

/// Frames that are left out of every scene.
enum LeftOut {
    /// Those of [`SceneSource::held_out`] of this number.
    HeldOut(usize),
    /// Frames of the source, in order.
    Frames(Vec<usize>),
}

impl SceneSubset {
    /// Keeps the scenes with these indices, which must exist in the source.
    pub fn new(source: Arc<dyn SceneSource>, scenes: Vec<usize>) -> Self {
        let positions = scenes.iter().enumerate().map(|(position, scene)| (*scene, position)).collect();
        Self { source, scenes, positions, left_out: LeftOut::HeldOut(0) }
    }

    /// Keeps at most the first `num_scenes` scenes.
    pub fn first(source: Arc<dyn SceneSource>, num_scenes: usize) -> Self {
        let scenes = (0..num_scenes.min(source.num_scenes())).collect();
        Self::new(source, scenes)
    }

    /// Keeps all scenes without their held-out frames.
    pub(crate) fn without_held_out(source: Arc<dyn SceneSource>, hold_out: usize) -> Self {
        Self { left_out: LeftOut::HeldOut(hold_out), ..Self::first(source, usize::MAX) }
    }

    /// Keeps one scene without the frames that [`SceneSource::check_frame`] refuses. Returns their positions and errors, too.
    pub fn readable(source: Arc<dyn SceneSource>, scene: usize) -> Result<(Self, Vec<(usize, DataError)>), DataError> {
        let frames = (0..source.num_frames(scene)?).into_par_iter();
        let bad: Vec<_> = frames.filter_map(|frame| Some((frame, source.check_frame(scene, frame).err()?))).collect();
        let left_out = LeftOut::Frames(bad.iter().map(|(frame, _)| *frame).collect());
        Ok((Self { left_out, ..Self::new(source, vec![scene]) }, bad))
    }

    /// Returns the frames of a scene of the source that are left out, in order.
    fn left_out(&self, scene: usize) -> Result<Vec<usize>, DataError> {
        match &self.left_out {
            LeftOut::HeldOut(every) => self.source.held_out(self.scenes[scene], *every),
            LeftOut::Frames(frames) => Ok(frames.clone()),
        }
    }

    /// Returns the number of a kept frame in the source.
    fn frame_in_source(&self, scene: usize, frame: usize) -> Result<usize, DataError> {
        let all = (0..self.source.num_frames(self.scenes[scene])?).collect();
        let kept: Vec<usize> = self.kept(scene, all)?;
        let (key, num_frames) = (self.key(scene), kept.len());
        kept.get(frame).copied().ok_or_else(|| DataError::NoSuchFrame { key: key.to_owned(), frame, num_frames })
    }

    /// Keeps the values of the kept frames, of values for the frames in the source.
    fn kept<T>(&self, scene: usize, values: Vec<T>) -> Result<Vec<T>, DataError> {
        let left_out = self.left_out(scene)?;
        let kept = values.into_iter().enumerate().filter(|(frame, _)| left_out.binary_search(frame).is_err());
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
        Ok(self.source.num_frames(self.scenes[scene])? - self.left_out(scene)?.len())
    }

    fn cameras(&self, scene: usize) -> Result<Vec<Camera<IntrinsicsNorm>>, DataError> {
        self.kept(scene, self.source.cameras(self.scenes[scene])?)
    }

    fn frame_names(&self, scene: usize) -> Result<Vec<String>, DataError> {
        self.kept(scene, self.source.frame_names(self.scenes[scene])?)
    }

    fn held_out(&self, scene: usize, every: usize) -> Result<Vec<usize>, DataError> {
        let held_out = self.source.held_out(self.scenes[scene], every)?;
        match &self.left_out {
            LeftOut::HeldOut(0) => Ok(held_out),
            LeftOut::HeldOut(_) => Ok(Vec::new()),
            LeftOut::Frames(left_out) => {
                let kept = held_out.iter().filter(|frame| left_out.binary_search(frame).is_err());
                Ok(kept.map(|frame| frame - left_out.partition_point(|other| other < frame)).collect())
            }
        }
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

    fn check_frame(&self, scene: usize, frame: usize) -> Result<(), DataError> {
        self.source.check_frame(self.scenes[scene], self.frame_in_source(scene, frame)?)
    }

    fn encoded_frame(&self, scene: usize, frame: usize) -> Result<Option<Vec<u8>>, DataError> {
        self.source.encoded_frame(self.scenes[scene], self.frame_in_source(scene, frame)?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene_source::{Split, is_held_out};
    use crate::sources::chunks::chunk_source::ChunkSource;
    use crate::sources::chunks::writer::{SceneRecord, write_chunks};
    use crate::sources::filters::SceneFilters;
    use crate::testing::{re10k_mini, rooms};

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

    #[test]
    fn damaged_frames_of_chunks_and_photos_are_left_out() {
        let torn = |mut bytes: Vec<u8>| {
            let middle = bytes.len() / 2;
            bytes[middle..].iter_mut().take(120).for_each(|byte| *byte = 0);
            bytes
        };
        let source = Arc::new(re10k_mini(Split::Test));
        let (whole, bad) = SceneSubset::readable(source.clone(), 0).unwrap();
        assert!(bad.is_empty() && whole.num_scenes() == 1 && whole.key(0) == source.key(0));
        let encoded = |frame| {
            let bytes = source.encoded_frame(0, frame).unwrap().unwrap();
            if [0, 3].contains(&frame) { torn(bytes) } else { bytes }
        };
        let cameras = source.cameras(0).unwrap();
        let images = (0..cameras.len()).map(encoded).collect();
        let folder = tempfile::tempdir().unwrap();
        let record = SceneRecord { key: source.key(0).into(), cameras, images };
        write_chunks(&folder.path().join("test"), [Ok(record)], u64::MAX).unwrap();
        let damaged = ChunkSource::open(folder.path(), Split::Test, &SceneFilters::default()).unwrap();
        let (readable, bad) = SceneSubset::readable(Arc::new(damaged), 0).unwrap();
        assert_eq!(bad.iter().map(|(frame, _)| *frame).collect::<Vec<_>>(), [0, 3]);
        assert!(bad[0].1.to_string().contains("image data"), "{}", bad[0].1);
        let num_frames = source.num_frames(0).unwrap();
        assert_eq!(readable.num_frames(0).unwrap(), num_frames - 2);
        assert_eq!(readable.frame(0, 2).unwrap(), source.frame(0, 4).unwrap());
        // Of 0, 2 and 4, the second and the third are left, as frames 1 and 2.
        assert_eq!(readable.held_out(0, 2).unwrap()[..2], [1, 2]);
    }
}
