//! Files and data sources for tests.

use std::path::{Path, PathBuf};

use clift_core::{Camera, IntrinsicsNorm, Pose, RgbImage};

use crate::error::DataError;
use crate::scene_source::{SceneSource, Split};
use crate::sources::chunks::chunk_source::ChunkSource;
use crate::sources::filters::SceneFilters;
use crate::synthetic::config::SyntheticConfig;
use crate::synthetic::source::SyntheticSource;

pub fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../data-fixtures").join(name)
}

/// Returns two training scenes, or one test scene, of RealEstate10K with eight frames.
pub fn re10k_mini(split: Split) -> ChunkSource {
    ChunkSource::open(&fixture("re10k-mini"), split, &SceneFilters::default()).unwrap()
}

/// Returns synthetic scenes; `change` departs from 32 x 32 pixels, 16 frames and 100 scenes.
pub fn rooms(change: impl FnOnce(&mut SyntheticConfig)) -> SyntheticSource {
    let mut config = SyntheticConfig::default();
    change(&mut config);
    SyntheticSource::new(config).unwrap()
}

/// Passes a file with these bytes to `read`.
pub fn read_from_file<T>(name: &str, bytes: impl AsRef<[u8]>, read: impl FnOnce(&Path) -> T) -> T {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(name);
    std::fs::write(&path, bytes).unwrap();
    read(&path)
}

/// Returns an image whose red and green rise along the columns and rows.
pub fn ramp(width: usize, height: usize) -> RgbImage {
    let rgb = (0..height).flat_map(|y| (0..width).flat_map(move |x| [(x * 3) as u8, (y * 5) as u8, 77])).collect();
    RgbImage { width, height, rgb }
}

type ReadCameras = dyn Fn(&dyn SceneSource, usize) -> Result<Vec<Camera<IntrinsicsNorm>>, DataError> + Send + Sync;
type ReadFrame = dyn Fn(&dyn SceneSource, usize, usize) -> Result<RgbImage, DataError> + Send + Sync;

/// The scenes of another source, with the cameras and frames of functions of a test, which receive that source.
pub struct TestSource {
    pub base: Box<dyn SceneSource>,
    pub cameras: Box<ReadCameras>,
    pub frame: Box<ReadFrame>,
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

    fn cameras(&self, scene: usize) -> Result<Vec<Camera<IntrinsicsNorm>>, DataError> {
        (self.cameras)(self.base.as_ref(), scene)
    }

    fn frame(&self, scene: usize, frame: usize) -> Result<RgbImage, DataError> {
        (self.frame)(self.base.as_ref(), scene, frame)
    }
}

/// Rooms of eight frames. The cameras of the second scene cannot be read.
pub fn rooms_with_a_broken_one(num_scenes: usize) -> TestSource {
    TestSource {
        base: Box::new(rooms(|c| (c.num_scenes, c.num_frames) = (num_scenes, 8))),
        cameras: Box::new(|base, scene| match scene {
            1 => Err(DataError::bad_camera("the pose holds NaN".into())),
            _ => base.cameras(scene),
        }),
        frame: Box::new(|base, scene, frame| base.frame(scene, frame)),
    }
}

/// Scenes with given numbers of frames of one pixel. The camera moves along the negative x axis, so that the first context
/// of a clip is normalised to a positive x.
pub fn scenes_of_lengths(lengths: Vec<usize>) -> TestSource {
    let intrinsics = IntrinsicsNorm { fx: 1.0, fy: 1.0, cx: 0.5, cy: 0.5 };
    let at = |frame: usize| Pose { translation: [-(frame as f64), 0.0, 0.0].into(), ..Pose::IDENTITY };
    let camera = move |frame: usize| Camera { c2w: at(frame), intrinsics };
    TestSource {
        base: Box::new(rooms(|c| c.num_scenes = lengths.len())),
        cameras: Box::new(move |_, scene| Ok((0..lengths[scene]).map(camera).collect())),
        frame: Box::new(|_, _, _| Ok(RgbImage { width: 1, height: 1, rgb: vec![0; 3] })),
    }
}
