//! Byte ranges of the cameras and frames of every scene in a chunk.

use std::collections::HashMap;
use std::path::Path;

use clift_core::{Camera, IntrinsicsNorm, widest_fov_deg};

use crate::error::DataError;
use crate::geometry::path_spread::far_cameras;
use crate::geometry::scaled_rotation::camera_of_row;
use crate::torch::archive::{Archive, ByteSpan, tensor_span};
use crate::torch::pickle::Pickle;
use crate::torch::values::{ElementType, MAX_VALUES, Value};

/// Largest number of frames of all scenes of a chunk. The size of the pickle does not bound it, because scenes may share
/// a list of frames. Scenes without sharing have at least 8 values per frame, thus fewer frames than this.
const MAX_FRAMES: usize = MAX_VALUES / 8;

/// Largest number of unusable frames of a scene; with more, the scene is unusable.
const MAX_UNUSABLE: usize = 1000;

/// Chunks that are examined between two calls of the progress callback.
pub(crate) const CHUNKS_PER_CALL: usize = 64;

/// Progress callback of a scan: numbers of examined chunks, and of all.
pub type ScanProgress<'a> = &'a mut dyn FnMut(usize, usize);

/// Peculiarities of a scene that the report notes.
pub(crate) const ODDITIES: [&str; 3] = [
    "without time stamps as int64: frames count 0, 1, ..",
    "with scaled rotations, whose scale was divided out",
    "with cameras far from the others, which set the scale if they are contexts",
];

pub(crate) struct SceneTable {
    pub key: String,
    cameras: ByteSpan,
    camera_type: ElementType,
    /// Images of the usable frames.
    pub images: Vec<ByteSpan>,
    /// Frames of the file whose cameras cannot be used, in order, with the reasons.
    pub unusable: Vec<(usize, String)>,
    /// Which of [`ODDITIES`] the scene has.
    pub oddities: [bool; ODDITIES.len()],
    /// Largest field of view of the usable frames, in degrees; `None` for unreadable cameras.
    pub fov_deg: Option<f64>,
}

pub(crate) struct ChunkTable {
    pub scenes: HashMap<String, SceneTable>,
    /// Whether the file was written without checksums.
    pub lacks_checksums: bool,
}

impl ChunkTable {
    /// Reads the directory, the pickle and the cameras of a chunk, and checks shape and bounds of every tensor that is used.
    /// Other entries may hold any object, which is not executed.
    pub fn read(path: &Path) -> Result<Self, DataError> {
        let bad = |what: String| DataError::BadChunk { what, path: path.to_path_buf() };
        let archive = Archive::open(path)?;
        let pickle = Pickle::parse(&archive.read_pickle(path)?, path)?;
        // A chunk is a list of scenes; files of one scene hold its dict.
        let scenes: Vec<&Value> = match pickle.root() {
            Value::List(items) => items.iter().map(|id| pickle.get(*id)).collect(),
            scene @ Value::Dict(_) => vec![scene],
            _ => return Err(bad("the outermost object is neither a list of scenes nor a scene".into())),
        };
        let mut builder = Builder { pickle: &pickle, archive: &archive, scenes: HashMap::new(), num_frames: 0 };
        for (position, scene) in scenes.into_iter().enumerate() {
            builder.add(scene).map_err(|what| bad(format!("scene {position}: {what}")))?;
        }
        let mut scenes = builder.scenes;
        for scene in scenes.values_mut() {
            scene.leave_out_unusable(path);
        }
        Ok(Self { scenes, lacks_checksums: archive.lacks_checksums() })
    }
}

/// Collects the scenes of a pickle. Values that scenes may share are counted for every scene, so that a file of a few kB
/// cannot fill the memory.
struct Builder<'a> {
    pickle: &'a Pickle,
    archive: &'a Archive,
    scenes: HashMap<String, SceneTable>,
    num_frames: usize,
}

impl Builder<'_> {
    fn add(&mut self, scene: &Value) -> Result<(), String> {
        let Self { pickle, archive, .. } = *self;
        let item = |name: &str| pickle.item(scene, name).ok_or_else(|| format!("no entry `{name}`"));
        let Value::Str(key) = item("key")? else { return Err("`key` is not a string".into()) };
        let in_scene = |what: String| format!("key {key:?}: {what}");
        if self.scenes.contains_key(key) {
            return Err(in_scene("it occurs twice".into()));
        }
        let Value::List(image_ids) = item("images")? else { return Err(in_scene("`images` is not a list".into())) };
        self.num_frames += image_ids.len();
        if self.num_frames > MAX_FRAMES {
            return Err(in_scene(format!("the scenes so far have more than the limit of {MAX_FRAMES} frames")));
        }
        let num_frames = image_ids.len() as u64;
        let mut images = Vec::with_capacity(image_ids.len());
        for (frame, id) in image_ids.iter().enumerate() {
            let (span, _) = tensor_span(pickle.get(*id), &[None], &[ElementType::U8], archive)
                .map_err(|what| in_scene(format!("`images[{frame}]`: {what}")))?;
            images.push(span);
        }
        let tensor = |name: &str, shape: &[Option<u64>], types: &[ElementType]| {
            tensor_span(item(name)?, shape, types, archive).map_err(|what| in_scene(format!("`{name}`: {what}")))
        };
        let (cameras, camera_type) =
            tensor("cameras", &[Some(num_frames), Some(18)], &[ElementType::F32, ElementType::F64])?;
        let oddities = [tensor("timestamps", &[Some(num_frames)], &[ElementType::I64]).is_err(), false, false];
        let (key, unusable, fov_deg) = (key.clone(), Vec::new(), None);
        let table = SceneTable { key, cameras, camera_type, images, unusable, oddities, fov_deg };
        self.scenes.insert(table.key.clone(), table);
        Ok(())
    }
}

impl SceneTable {
    /// Leaves out the frames whose cameras cannot be used. An unreadable tensor of cameras is an error at its use.
    fn leave_out_unusable(&mut self, path: &Path) {
        let Ok(rows) = self.read_rows(path) else { return };
        let mut cameras = Vec::with_capacity(rows.len());
        for (frame, row) in rows.into_iter().enumerate() {
            match camera_of_row(row) {
                Ok((camera, scale)) => {
                    self.oddities[1] |= scale.is_some();
                    cameras.push(camera);
                }
                Err(error) => self.unusable.push((frame, format!("whose camera cannot be used: {error}"))),
            }
            if self.unusable.len() > MAX_UNUSABLE {
                self.unusable.truncate(1);
                self.images.clear();
                return;
            }
        }
        let centres: Vec<_> = cameras.iter().map(|camera| camera.c2w.translation).collect();
        self.oddities[2] = !far_cameras(&centres).is_empty();
        self.fov_deg = Some(widest_fov_deg(&cameras));
        let images = std::mem::take(&mut self.images);
        self.images = self.usable(images);
    }

    /// Keeps the values of the usable frames, of values for all frames of the file.
    fn usable<T>(&self, values: Vec<T>) -> Vec<T> {
        let is_usable = |frame: usize| self.unusable.binary_search_by_key(&frame, |(frame, _)| *frame).is_err();
        values.into_iter().enumerate().filter(|(frame, _)| is_usable(*frame)).map(|(_, value)| value).collect()
    }

    fn read_rows(&self, path: &Path) -> Result<Vec<[f64; 18]>, DataError> {
        let bytes = self.cameras.read(path)?;
        let numbers: Vec<f64> = match self.camera_type {
            ElementType::F64 => bytes.as_chunks().0.iter().map(|bytes| f64::from_le_bytes(*bytes)).collect(),
            _ => bytes.as_chunks().0.iter().map(|bytes| f64::from(f32::from_le_bytes(*bytes))).collect(),
        };
        Ok(numbers.as_chunks::<18>().0.to_vec())
    }

    pub fn read_cameras(&self, path: &Path) -> Result<Vec<Camera<IntrinsicsNorm>>, DataError> {
        let bad = |error| DataError::BadChunk { what: format!("scene {}: {error}", self.key), path: path.into() };
        let camera = |row| camera_of_row(row).map(|(camera, _)| camera).map_err(bad);
        self.usable(self.read_rows(path)?).into_iter().map(camera).collect()
    }
}
