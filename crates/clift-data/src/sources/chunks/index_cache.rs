//! The chunk index cache: numbers of frames and fields of view of all scenes of a data set, on disk. With it, opening a data
//! set with filters reads the tables of changed chunks only.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::UNIX_EPOCH;

use clift_core::{replace_file, widest_fov_deg};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::error::DataError;
use crate::sources::chunks::table::{ChunkTable, SceneTable};

/// Version of the file; other versions are ignored.
const VERSION: u32 = 3;

/// Scenes of a chunk.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct CachedChunk {
    /// Size of the file in bytes, and time of its last change.
    stamp: (u64, u64),
    /// All scenes of the chunk by key.
    pub scenes: BTreeMap<String, CachedScene>,
}

/// Values of a scene that the filters compare.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct CachedScene {
    pub num_frames: usize,
    /// Largest field of view of any frame, in degrees; `None` if not computed.
    pub fov_deg: Option<f64>,
    /// Unusable frames with their reasons.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub unusable: Vec<(usize, String)>,
}

impl CachedChunk {
    /// Counts the scenes of the chunk at `path`, with their fields of view if `needs_fov`. `table` reads its table.
    pub fn of<'a>(
        path: &Path,
        table: impl FnOnce() -> Result<&'a ChunkTable, DataError>,
        needs_fov: bool,
    ) -> Result<Self, DataError> {
        // Before reading: a file that changes meanwhile is read again at the next opening.
        let stamp = stamp(path).map_err(DataError::io("opening a chunk", path))?;
        let scene = |(key, scene): (&String, &SceneTable)| {
            let fov_deg = match (needs_fov, scene.fov_deg) {
                (true, None) => Some(widest_fov_deg(&scene.read_cameras(path)?)),
                (true, known) => known,
                (false, _) => None,
            };
            Ok((key.clone(), CachedScene { num_frames: scene.images.len(), fov_deg, unusable: scene.unusable.clone() }))
        };
        Ok(Self { stamp, scenes: table()?.scenes.iter().map(scene).collect::<Result<_, DataError>>()? })
    }

    /// Returns whether the file at `path` is unchanged, and the entry has what the filters need.
    pub fn is_current(&self, path: &Path, needs_fov: bool) -> bool {
        let has_fov = || self.scenes.values().all(|scene| scene.fov_deg.is_some());
        stamp(path).is_ok_and(|stamp| stamp == self.stamp) && (!needs_fov || has_fov())
    }
}

/// Returns size and time of a file.
fn stamp(path: &Path) -> std::io::Result<(u64, u64)> {
    let metadata = std::fs::metadata(path)?;
    let time = metadata.modified()?.duration_since(UNIX_EPOCH).unwrap_or_default();
    Ok((metadata.len(), time.as_nanos() as u64))
}

/// The cached chunks of a folder, by file name.
#[derive(Default, Serialize, Deserialize)]
pub(crate) struct ChunkIndexCache {
    version: u32,
    pub chunks: BTreeMap<String, CachedChunk>,
}

impl ChunkIndexCache {
    /// Returns the path of the cache of `folder`, below the folder for caches.
    pub fn path(caches: &Path, folder: &Path) -> PathBuf {
        let folder = std::path::absolute(folder).unwrap_or_else(|_| folder.to_owned());
        let hash = Sha256::digest(folder.as_os_str().as_encoded_bytes());
        caches.join("chunk-index").join(format!("{}.json", hex::encode(&hash[..16])))
    }

    /// Reads a cache; an unreadable file is an empty cache.
    pub fn read(path: &Path) -> Self {
        let read = std::fs::read(path).ok().and_then(|text| serde_json::from_slice(&text).ok());
        read.filter(|cache: &Self| cache.version == VERSION).unwrap_or_default()
    }

    /// Writes the cache. A failure only costs time at the next opening.
    pub fn write(chunks: BTreeMap<String, CachedChunk>, path: &Path) {
        let cache = Self { version: VERSION, chunks };
        if let (Ok(text), Some(folder)) = (serde_json::to_vec(&cache), path.parent()) {
            let _ = std::fs::create_dir_all(folder).and_then(|()| replace_file(path, &text));
        }
    }
}
