//! A census of chunks, cached on disk: with it, opening a data set with filters reads the tables of changed chunks only.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, OnceLock, PoisonError};
use std::time::UNIX_EPOCH;

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use clift_core::{replace_file, widest_fov_deg};

use crate::error::DataError;
use crate::sources::chunks::table::{ChunkTable, SceneTable};

/// Version of the file; other versions are ignored.
const VERSION: u32 = 1;

/// What is called with the numbers of examined and of all chunks.
static OBSERVER: OnceLock<fn(usize, usize)> = OnceLock::new();

/// Has `observer` called, for the whole process, while the chunks of a data set are examined: after each chunk, with the
/// number of examined ones and the number of all, in order. The first opening of a large data set reads every chunk and can
/// take minutes. Only the first observer counts.
pub fn observe_census(observer: fn(usize, usize)) {
    // A second observer is ignored, as documented.
    let _ = OBSERVER.set(observer);
}

/// Counts examined chunks.
pub(crate) struct Progress {
    done: Mutex<usize>,
    total: usize,
}

impl Progress {
    pub fn of(total: usize) -> Self {
        Self { done: Mutex::new(0), total }
    }

    pub fn advance(&self) {
        // Locked during the call, so that numbers arrive in order.
        let mut done = self.done.lock().unwrap_or_else(PoisonError::into_inner);
        *done += 1;
        if let Some(observer) = OBSERVER.get() {
            observer(*done, self.total);
        }
    }
}

/// Scenes of a chunk.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct ChunkCensus {
    /// Size of the file in bytes, and time of its last change.
    stamp: (u64, u64),
    /// All scenes of the chunk by key.
    pub scenes: BTreeMap<String, SceneCensus>,
}

/// What the filters depend on.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct SceneCensus {
    pub num_frames: usize,
    /// Largest field of view of any frame, in degrees; `None` if not computed.
    pub fov_deg: Option<f64>,
}

impl ChunkCensus {
    /// Counts the scenes of the chunk at `path`, with their fields of view if `needs_fov`. `table` reads its table.
    ///
    /// # Errors
    /// Those of reading the file and the cameras.
    pub fn of<'a>(
        path: &Path,
        table: impl FnOnce() -> Result<&'a ChunkTable, DataError>,
        needs_fov: bool,
    ) -> Result<Self, DataError> {
        // Before reading: a file that changes meanwhile is read again at the next opening.
        let stamp = stamp(path).map_err(DataError::io("opening a chunk", path))?;
        let scene = |(key, scene): (&String, &SceneTable)| {
            let fov_deg = if needs_fov { Some(widest_fov_deg(&scene.read_cameras(path)?)) } else { None };
            Ok((key.clone(), SceneCensus { num_frames: scene.images.len(), fov_deg }))
        };
        Ok(Self { stamp, scenes: table()?.scenes.iter().map(scene).collect::<Result<_, DataError>>()? })
    }

    /// Returns whether the file at `path` is unchanged, and the census has what the filters need.
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

/// The census of a folder of chunks, by file name.
#[derive(Default, Serialize, Deserialize)]
pub(crate) struct Census {
    version: u32,
    pub chunks: BTreeMap<String, ChunkCensus>,
}

impl Census {
    /// Returns the file of the census of `folder`, below the folder for caches.
    pub fn path(caches: &Path, folder: &Path) -> PathBuf {
        let folder = std::path::absolute(folder).unwrap_or_else(|_| folder.to_owned());
        let hash = Sha256::digest(folder.as_os_str().as_encoded_bytes());
        caches.join("census").join(format!("{}.json", hex::encode(&hash[..16])))
    }

    /// Reads a census; without a readable one, the census is empty.
    pub fn read(path: &Path) -> Self {
        let read = std::fs::read(path).ok().and_then(|text| serde_json::from_slice(&text).ok());
        read.filter(|census: &Self| census.version == VERSION).unwrap_or_default()
    }

    /// Writes the census. A failure only costs time at the next opening.
    pub fn write(chunks: BTreeMap<String, ChunkCensus>, path: &Path) {
        let census = Self { version: VERSION, chunks };
        if let (Ok(text), Some(folder)) = (serde_json::to_vec(&census), path.parent()) {
            let _ = std::fs::create_dir_all(folder).and_then(|()| replace_file(path, &text));
        }
    }
}
