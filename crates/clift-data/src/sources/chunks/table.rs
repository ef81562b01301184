//! Byte ranges of the cameras, time stamps and frames of every scene in a chunk.

use std::collections::HashMap;
use std::path::Path;

use clift_core::{Camera, IntrinsicsNorm};

use crate::error::DataError;
use crate::image::codec::check_encoded;
use crate::sources::chunks::writer::{camera_bytes, timestamp_bytes};
use crate::torch::archive::{Archive, ByteSpan};
use crate::torch::pickle::Pickle;
use crate::torch::tensor_span::tensor_span;
use crate::torch::values::{ElementType, MAX_BYTES, MAX_VALUES, Value};

/// Largest number of frames of all scenes of a chunk. The size of the pickle does not bound it, because scenes may share
/// a list of frames. Scenes without sharing have at least 8 values per frame, thus fewer frames than this.
const MAX_FRAMES: usize = MAX_VALUES / 8;

pub(crate) struct SceneTable {
    pub key: String,
    pub url: String,
    timestamps: ByteSpan,
    cameras: ByteSpan,
    camera_type: ElementType,
    pub images: Vec<ByteSpan>,
}

pub(crate) struct ChunkTable {
    pub scenes: HashMap<String, SceneTable>,
}

impl ChunkTable {
    /// Reads the directory and the pickle of a chunk, and checks shape and bounds of every tensor.
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
        let mut builder =
            Builder { pickle: &pickle, archive: &archive, scenes: HashMap::new(), num_frames: 0, url_bytes: 0 };
        for (position, scene) in scenes.into_iter().enumerate() {
            builder.add(scene).map_err(|what| bad(format!("scene {position}: {what}")))?;
        }
        Ok(Self { scenes: builder.scenes })
    }
}

/// Collects the scenes of a pickle. Values that scenes may share are counted for every scene, so that a file of a few kB
/// cannot fill the memory.
struct Builder<'a> {
    pickle: &'a Pickle,
    archive: &'a Archive,
    scenes: HashMap<String, SceneTable>,
    num_frames: usize,
    url_bytes: usize,
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
        let url = match pickle.item(scene, "url") {
            Some(Value::Str(url)) => url.as_str(),
            _ => "",
        };
        self.url_bytes += url.len();
        if self.url_bytes > MAX_BYTES {
            return Err(in_scene(format!("the `url`s so far have more than the limit of {MAX_BYTES} bytes")));
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
        let (timestamps, _) = tensor("timestamps", &[Some(num_frames)], &[ElementType::I64])?;
        let table = SceneTable { key: key.clone(), url: url.to_owned(), timestamps, cameras, camera_type, images };
        self.scenes.insert(key.clone(), table);
        Ok(())
    }
}

impl SceneTable {
    pub fn read_cameras(&self, path: &Path) -> Result<Vec<Camera<IntrinsicsNorm>>, DataError> {
        let bytes = self.cameras.read(path)?;
        let numbers: Vec<f64> = match self.camera_type {
            ElementType::F64 => bytes.as_chunks().0.iter().map(|bytes| f64::from_le_bytes(*bytes)).collect(),
            _ => bytes.as_chunks().0.iter().map(|bytes| f64::from(f32::from_le_bytes(*bytes))).collect(),
        };
        let (rows, _) = numbers.as_chunks::<18>();
        let camera = |(frame, row): (usize, &[f64; 18])| {
            Camera::from_re10k(*row).map_err(|source| DataError::BadChunk {
                what: format!("scene {}, frame {frame}: {source}", self.key),
                path: path.to_path_buf(),
            })
        };
        rows.iter().enumerate().map(camera).collect()
    }

    pub fn read_timestamps(&self, path: &Path) -> Result<Vec<i64>, DataError> {
        Ok(self.timestamps.read(path)?.as_chunks().0.iter().map(|bytes| i64::from_le_bytes(*bytes)).collect())
    }

    /// Checks the image files without decoding them. Returns the unreadable ones with the reason.
    pub fn unreadable_images(&self, path: &Path) -> Vec<(usize, String)> {
        let reason = |span: &ByteSpan| match span.read(path) {
            Ok(bytes) => check_encoded(&bytes).err(),
            Err(error) => Some(error.to_string()),
        };
        self.images.iter().enumerate().filter_map(|(frame, span)| Some((frame, reason(span)?))).collect()
    }

    /// Returns whether these time stamps and cameras, one per frame, equal those of the file after rounding to f32.
    pub fn is_of(
        &self,
        path: &Path,
        timestamps: &[i64],
        cameras: &[Camera<IntrinsicsNorm>],
    ) -> Result<bool, DataError> {
        Ok(self.timestamps.read(path)? == timestamp_bytes(timestamps)
            && self.cameras.read(path)? == camera_bytes(cameras))
    }
}
