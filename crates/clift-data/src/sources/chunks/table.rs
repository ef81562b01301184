//! What one chunk holds: for each of its scenes, where cameras, time stamps and frames lie in the file.

use std::collections::HashMap;
use std::path::Path;

use crate::error::DataError;
use crate::geometry::camera::Camera;
use crate::sources::chunks::writer::{camera_bytes, timestamp_bytes};
use crate::torch::archive::{Archive, ByteSpan};
use crate::torch::pickle::Pickle;
use crate::torch::tensor_span::tensor_span;
use crate::torch::values::{ElementType, MAX_BYTES, MAX_VALUES, Value};

/// Most frames of all scenes of a chunk. Scenes may share a list of frames, so that the size of the pickle does not
/// limit them; those that do not share have 8 values or more per frame, and fewer frames than this.
const MAX_FRAMES: usize = MAX_VALUES / 8;

/// One scene of a chunk. Pictures and cameras stay in the file.
pub(crate) struct SceneTable {
    pub key: String,
    pub url: String,
    timestamps: ByteSpan,
    cameras: ByteSpan,
    camera_type: ElementType,
    pub images: Vec<ByteSpan>,
}

/// The scenes of one chunk, by key.
pub(crate) struct ChunkTable {
    pub scenes: HashMap<String, SceneTable>,
}

impl ChunkTable {
    /// Reads a chunk's directory and pickle, and checks that every tensor has the shape the format asks for and
    /// lies within its storage.
    pub fn read(path: &Path) -> Result<Self, DataError> {
        let bad = |what: String| DataError::BadChunk { what, path: path.to_path_buf() };
        let archive = Archive::open(path)?;
        let member = archive
            .member("data.pkl")
            .ok_or_else(|| bad("no member data.pkl, so torch.save did not write it".into()))?;
        if member.len() > MAX_BYTES as u64 {
            return Err(bad(format!("data.pkl has {} bytes, more than the limit of {MAX_BYTES}", member.len())));
        }
        let pickle = Pickle::parse(&member.read(path)?, path)?;
        // A chunk is a list of scenes; one scene per file (a bare dict) is a common variant.
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

/// Collects the scenes of a pickle. What several scenes may share is counted: a file of a few kB must not fill the
/// memory.
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
        let Value::Str(key) = item("key")? else { return Err("`key` is no string".into()) };
        let in_scene = |what: String| format!("key {key:?}: {what}");
        if self.scenes.contains_key(key) {
            return Err(in_scene("it comes twice".into()));
        }
        let url = match pickle.item(scene, "url") {
            Some(Value::Str(url)) => url.as_str(),
            _ => "",
        };
        self.url_bytes += url.len();
        if self.url_bytes > MAX_BYTES {
            return Err(in_scene(format!("the `url`s so far have more than the limit of {MAX_BYTES} bytes")));
        }
        let Value::List(image_ids) = item("images")? else { return Err(in_scene("`images` is no list".into())) };
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
        let (cameras, camera_type) = tensor_span(
            item("cameras")?,
            &[Some(num_frames), Some(18)],
            &[ElementType::F32, ElementType::F64],
            archive,
        )
        .map_err(|what| in_scene(format!("`cameras`: {what}")))?;
        let (timestamps, _) = tensor_span(item("timestamps")?, &[Some(num_frames)], &[ElementType::I64], archive)
            .map_err(|what| in_scene(format!("`timestamps`: {what}")))?;
        let table = SceneTable { key: key.clone(), url: url.to_owned(), timestamps, cameras, camera_type, images };
        self.scenes.insert(key.clone(), table);
        Ok(())
    }
}

impl SceneTable {
    /// Reads every camera of the scene.
    pub fn read_cameras(&self, path: &Path) -> Result<Vec<Camera>, DataError> {
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

    /// Reads the time stamp of every frame.
    pub fn read_timestamps(&self, path: &Path) -> Result<Vec<i64>, DataError> {
        let bytes = self.timestamps.read(path)?;
        Ok(bytes.as_chunks().0.iter().map(|bytes| i64::from_le_bytes(*bytes)).collect())
    }

    /// Whether a scene with these time stamps and cameras, as many as it has frames, would be written with the same
    /// numbers.
    pub fn is_of(&self, path: &Path, timestamps: &[i64], cameras: &[Camera]) -> Result<bool, DataError> {
        Ok(self.timestamps.read(path)? == timestamp_bytes(timestamps)
            && self.cameras.read(path)? == camera_bytes(cameras))
    }
}
