//! Any source as pixelSplat's chunks or as one file per scene, resumable and with checksums.

use std::collections::{BTreeMap, HashSet};
use std::path::{Path, PathBuf};

use rayon::prelude::*;

use crate::chunk_table::ChunkTable;
use crate::chunk_writer::{SceneRecord, chunk_name, write_chunk, write_scene_file};
use crate::clip::SceneSource;
use crate::error::DataError;
use crate::export::Encoding;
use crate::files::replace;
use crate::journal::Journal;
use crate::ledger::Skip;

/// What is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ConvertTo {
    /// `NNNNNN.torch` files of many scenes, each closed at so many bytes of pictures, and `index.json`.
    Chunks {
        /// Bytes of pictures.
        target_bytes: u64,
    },
    /// `<key>.torch`, a file per scene.
    Scenes,
}

/// How it is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ConvertOptions {
    /// Files.
    pub to: ConvertTo,
    /// How a frame is stored that has no file of its own: computed ones, and those whose lens distortion was undone.
    /// Others keep theirs, byte by byte.
    pub encoding: Encoding,
}

/// What was written.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Converted {
    /// Scenes in the folder.
    pub num_scenes: usize,
    /// Scenes of these that were there already, from a conversion that did not end.
    pub num_found: usize,
    /// Frames written now.
    pub num_frames: usize,
    /// Frames of these that had to be encoded.
    pub num_encoded: usize,
    /// Bytes of the pictures written now.
    pub image_bytes: u64,
    /// Scenes that could not be read, with the reason.
    pub skipped: Vec<Skip>,
}

/// Writes the scenes of `source` into `folder`; one that cannot be read is left out, with the reason in the result.
///
/// Every file appears under its name only when it is complete, and then its SHA-256 in `SHA256SUMS`, which
/// `sha256sum -c` reads. Called again on a folder that was not finished, it keeps the files whose sums still hold and
/// goes on with the scenes that are missing; on one that was finished, it verifies all sums. `done` is told how many
/// scenes are ready.
///
/// # Errors
/// [`DataError::Io`] from writing, [`DataError::BadIndex`] for a folder with other files or of other scenes.
pub fn convert(
    source: &dyn SceneSource,
    folder: &Path,
    options: ConvertOptions,
    mut done: impl FnMut(usize),
) -> Result<Converted, DataError> {
    let mut journal = Journal::open(folder)?;
    let mut writer = Writer::resume(source, folder, &mut journal)?;
    writer.converted.num_found = writer.index.len();
    for scene in 0..source.num_scenes() {
        let key = source.key(scene);
        if !writer.index.contains_key(key) && !writer.pending_keys.contains(key) {
            match record(source, scene, options.encoding) {
                Ok((record, num_encoded)) => writer.add(record, num_encoded, options.to)?,
                Err(error) => writer.converted.skipped.push(Skip { key: key.to_owned(), reason: error.to_string() }),
            }
        }
        done(writer.index.len() + writer.pending.len());
    }
    writer.finish(options.to)
}

/// Reads a scene; also says how many of its frames had to be encoded.
fn record(source: &dyn SceneSource, scene: usize, encoding: Encoding) -> Result<(SceneRecord, usize), DataError> {
    let cameras = source.cameras(scene)?;
    let timestamps = source.timestamps(scene)?;
    let read = |frame: usize| {
        Ok(match source.encoded_frame(scene, frame)? {
            Some(bytes) => (bytes, false),
            None => (encoding.encode(&source.frame(scene, frame)?)?, true),
        })
    };
    let images: Vec<(Vec<u8>, bool)> =
        (0..cameras.len()).into_par_iter().map(read).collect::<Result<_, DataError>>()?;
    let num_encoded = images.iter().filter(|(_, is_encoded)| *is_encoded).count();
    let images = images.into_iter().map(|(bytes, _)| bytes).collect();
    let key = source.key(scene).to_owned();
    Ok((SceneRecord { key, url: source.url(scene)?, timestamps, cameras, images }, num_encoded))
}

/// Collects scenes and writes them when there are enough.
struct Writer<'a> {
    folder: &'a Path,
    journal: &'a mut Journal,
    /// File of every scene that is written.
    index: BTreeMap<String, String>,
    pending: Vec<SceneRecord>,
    pending_keys: HashSet<String>,
    pending_bytes: u64,
    converted: Converted,
}

impl<'a> Writer<'a> {
    /// Takes up the scenes of the files that the journal knows.
    fn resume(source: &dyn SceneSource, folder: &'a Path, journal: &'a mut Journal) -> Result<Self, DataError> {
        let mut index = BTreeMap::new();
        for name in journal.names().filter(|name| Path::new(name).extension().is_some_and(|ending| ending == "torch")) {
            let path = folder.join(name);
            for key in ChunkTable::read(&path)?.scenes.into_keys() {
                if source.find(&key).is_none() {
                    let what = format!("it holds scene {key}, which is not to be converted; choose another folder");
                    return Err(DataError::BadIndex { what, path });
                }
                index.insert(key, name.to_owned());
            }
        }
        Ok(Self {
            folder,
            journal,
            index,
            pending: Vec::new(),
            pending_keys: HashSet::new(),
            pending_bytes: 0,
            converted: Converted::default(),
        })
    }

    fn add(&mut self, record: SceneRecord, num_encoded: usize, to: ConvertTo) -> Result<(), DataError> {
        let image_bytes = record.images.iter().map(|image| image.len() as u64).sum::<u64>();
        if let Err(what) = record.check() {
            self.converted.skipped.push(Skip { key: record.key, reason: what });
            return Ok(());
        }
        if to == ConvertTo::Scenes && !is_file_name(&record.key) {
            let reason = "its key is no name for a file; convert to chunks".into();
            self.converted.skipped.push(Skip { key: record.key, reason });
            return Ok(());
        }
        self.converted.num_frames += record.images.len();
        self.converted.num_encoded += num_encoded;
        self.converted.image_bytes += image_bytes;
        self.pending_bytes += image_bytes;
        self.pending_keys.insert(record.key.clone());
        self.pending.push(record);
        match to {
            ConvertTo::Chunks { target_bytes } if self.pending_bytes < target_bytes => Ok(()),
            _ => self.flush(to),
        }
    }

    fn flush(&mut self, to: ConvertTo) -> Result<(), DataError> {
        let scenes = std::mem::take(&mut self.pending);
        let Some(first) = scenes.first() else { return Ok(()) };
        let name = match to {
            ConvertTo::Chunks { .. } => self.free_name(),
            ConvertTo::Scenes => format!("{}.torch", first.key),
        };
        let path = self.folder.join(&name);
        match to {
            ConvertTo::Chunks { .. } => write_chunk(&path, &scenes)?,
            ConvertTo::Scenes => write_scene_file(&path, first)?,
        }
        self.journal.add(&name)?;
        self.index.extend(scenes.into_iter().map(|scene| (scene.key, name.clone())));
        self.pending_keys.clear();
        self.pending_bytes = 0;
        Ok(())
    }

    /// The first chunk name that is not in use.
    fn free_name(&self) -> String {
        let used: HashSet<&String> = self.index.values().collect();
        // Of one name more than there are files, one is free.
        (0..=used.len()).map(chunk_name).find(|name| !used.contains(name)).unwrap_or_default()
    }

    fn finish(mut self, to: ConvertTo) -> Result<Converted, DataError> {
        self.flush(to)?;
        if let ConvertTo::Chunks { .. } = to {
            let path: PathBuf = self.folder.join("index.json");
            let bad = |error: serde_json::Error| DataError::BadIndex { what: error.to_string(), path: path.clone() };
            let text = serde_json::to_vec_pretty(&self.index).map_err(bad)?;
            replace(&path, &text).map_err(DataError::io("writing the index", &path))?;
            self.journal.add("index.json")?;
        }
        let path = self.folder.join("skipped.json");
        if !self.converted.skipped.is_empty() {
            let bad = |error: serde_json::Error| DataError::BadIndex { what: error.to_string(), path: path.clone() };
            let text = serde_json::to_vec_pretty(&self.converted.skipped).map_err(bad)?;
            replace(&path, &text).map_err(DataError::io("writing what was skipped", &path))?;
        } else if path.exists() {
            std::fs::remove_file(&path).map_err(DataError::io("removing an older list of what was skipped", &path))?;
        }
        self.converted.num_scenes = self.index.len();
        Ok(self.converted)
    }
}

fn is_file_name(key: &str) -> bool {
    !key.is_empty() && !key.starts_with('.') && !key.contains(['/', '\\', '\0', ':', '\n'])
}

#[cfg(test)]
mod tests;
