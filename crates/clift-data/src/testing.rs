//! Files and data sources for tests.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use clift_core::{Camera, IntrinsicsNorm, Pose, RgbImage};

use crate::error::DataError;
use crate::files::listing::file_names;
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

pub fn names(folder: &Path) -> Vec<String> {
    file_names(folder).unwrap()
}

/// Returns an image whose red and green rise along the columns and rows.
pub fn ramp(width: usize, height: usize) -> RgbImage {
    let rgb = (0..height).flat_map(|y| (0..width).flat_map(move |x| [(x * 3) as u8, (y * 5) as u8, 77])).collect();
    RgbImage { width, height, rgb }
}

/// Asserts that two sources have the same scenes; cameras up to the precision of f32 files.
pub fn assert_same(a: &dyn SceneSource, b: &dyn SceneSource) {
    assert_eq!(a.num_scenes(), b.num_scenes());
    for scene in 0..a.num_scenes() {
        let other = b.find(a.key(scene)).unwrap();
        assert_eq!(a.timestamps(scene).unwrap(), b.timestamps(other).unwrap());
        assert_eq!(a.url(scene).unwrap(), b.url(other).unwrap());
        let (cameras, others) = (a.cameras(scene).unwrap(), b.cameras(other).unwrap());
        assert_eq!(cameras.len(), others.len());
        for (frame, (camera, other_camera)) in cameras.iter().zip(&others).enumerate() {
            assert_eq!(a.frame(scene, frame).unwrap(), b.frame(other, frame).unwrap());
            for (x, y) in camera.to_re10k().iter().zip(other_camera.to_re10k()) {
                assert!((x - y).abs() < 1e-6 * (1.0 + x.abs()), "{x} {y}"); // f32 files
            }
        }
    }
}

type ChangeCameras =
    dyn Fn(usize, Vec<Camera<IntrinsicsNorm>>) -> Result<Vec<Camera<IntrinsicsNorm>>, DataError> + Send + Sync;
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
    pub fn new(base: impl SceneSource + 'static) -> Self {
        Self {
            base: Arc::new(base),
            cameras: Box::new(|_, cameras| Ok(cameras)),
            frame: Box::new(|_, _, frame| Ok(frame)),
            encoded_frame: Box::new(|_, _| None),
        }
    }

    pub fn with_cameras(
        self,
        change: impl Fn(usize, Vec<Camera<IntrinsicsNorm>>) -> Result<Vec<Camera<IntrinsicsNorm>>, DataError>
        + Send
        + Sync
        + 'static,
    ) -> Self {
        Self { cameras: Box::new(change), ..self }
    }

    pub fn with_frames(
        self,
        change: impl Fn(usize, usize, RgbImage) -> Result<RgbImage, DataError> + Send + Sync + 'static,
    ) -> Self {
        Self { frame: Box::new(change), ..self }
    }

    pub fn with_torn_frames(self, is_torn: impl Fn(usize) -> bool + Send + Sync + 'static) -> Self {
        self.with_frames(move |scene, frame, decoded| {
            let torn = || DataError::BadImage { key: scene.to_string(), frame, what: "it is torn".into() };
            if is_torn(scene) { Err(torn()) } else { Ok(decoded) }
        })
    }

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

    fn cameras(&self, scene: usize) -> Result<Vec<Camera<IntrinsicsNorm>>, DataError> {
        (self.cameras)(scene, self.base.cameras(scene)?)
    }

    fn frame(&self, scene: usize, frame: usize) -> Result<RgbImage, DataError> {
        (self.frame)(scene, frame, self.base.frame(scene, frame)?)
    }

    fn encoded_frame(&self, scene: usize, frame: usize) -> Result<Option<Vec<u8>>, DataError> {
        Ok((self.encoded_frame)(scene, frame))
    }
}

/// Scenes with given numbers of frames of one pixel. The camera moves along the negative x axis, so that the first context
/// of a clip is normalised to a positive x.
pub struct Lengths {
    lengths: Vec<usize>,
    keys: Vec<String>,
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

    fn cameras(&self, scene: usize) -> Result<Vec<Camera<IntrinsicsNorm>>, DataError> {
        let intrinsics = IntrinsicsNorm { fx: 1.0, fy: 1.0, cx: 0.5, cy: 0.5 };
        let at = |frame: usize| Pose { translation: [-(frame as f64), 0.0, 0.0].into(), ..Pose::IDENTITY };
        Ok((0..self.lengths[scene]).map(|frame| Camera { c2w: at(frame), intrinsics }).collect())
    }

    fn num_frames(&self, scene: usize) -> Result<usize, DataError> {
        Ok(self.lengths[scene])
    }

    fn frame(&self, _scene: usize, _frame: usize) -> Result<RgbImage, DataError> {
        Ok(RgbImage { width: 1, height: 1, rgb: vec![0; 3] })
    }
}
