//! Any source as pixelSplat's chunks or as one file per scene, resumable and with checksums.

use std::collections::{BTreeMap, BTreeSet, HashSet};
use std::path::{Path, PathBuf};

use rayon::prelude::*;

use crate::chunk_table::{ChunkTable, SceneTable};
use crate::chunk_writer::{SceneRecord, chunk_bytes, chunk_name, scene_file_bytes};
use crate::clip::SceneSource;
use crate::error::DataError;
use crate::export::Encoding;
use crate::journal::Journal;
use crate::ledger::Ledger;
use crate::picture_folder::has_ending;

/// Scenes of `chunks`, by key: the file of each.
const INDEX: &str = "index.json";
/// The [`Ledger`] of what is not in the folder.
const SKIPPED: &str = "skipped.json";

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
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ConvertOptions {
    /// Files.
    pub to: ConvertTo,
    /// How a frame is stored that has no file of its own: computed ones, and those whose lens distortion was undone.
    /// Others keep theirs, byte by byte.
    pub encoding: Encoding,
    /// What the source was opened with, on one line; empty for the defaults.
    pub opened_with: String,
}

impl ConvertOptions {
    /// What two runs on one folder have to share, on one line.
    fn made_as(&self) -> String {
        let form = match self.to {
            ConvertTo::Chunks { target_bytes } => format!("chunks of {target_bytes} bytes"),
            ConvertTo::Scenes => "a file per scene".into(),
        };
        let pictures = match self.encoding {
            Encoding::Png => "PNG".into(),
            Encoding::Jpeg(quality) => format!("JPEG of quality {quality}"),
        };
        let with = if self.opened_with.is_empty() { "" } else { ", with " };
        format!("{form}, {pictures}{with}{}", self.opened_with)
    }
}

/// What was written.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Converted {
    /// Scenes in the folder.
    pub num_scenes: usize,
    /// Scenes of these that were there already, from a conversion that did not end.
    pub num_found: usize,
    /// Scenes that were there with other cameras, time stamps or numbers of frames than they have now; written anew.
    pub num_changed: usize,
    /// Frames written now.
    pub num_frames: usize,
    /// Frames of these that had to be encoded.
    pub num_encoded: usize,
    /// Bytes of the pictures written now.
    pub image_bytes: u64,
    /// What opening the source left out, and scenes that could not be read.
    pub left_out: Ledger,
}

/// Opens a [`Conversion`] and runs it.
///
/// # Errors
/// As both.
pub fn convert(
    source: &dyn SceneSource,
    left_out: &Ledger,
    folder: &Path,
    options: &ConvertOptions,
    done: impl FnMut(usize),
) -> Result<Converted, DataError> {
    Conversion::open(source, left_out, folder, options)?.run(done)
}

/// A folder that is to receive the scenes of a source.
///
/// Every file appears under its name only when it is complete, its SHA-256 in `SHA256SUMS`, which `sha256sum -c`
/// reads. In a folder that was not finished, files are kept whose sums still hold and whose scenes still have the
/// cameras, time stamps and numbers of frames of the source, and the rest is made; in one that was finished, all sums
/// are verified. Pictures are not compared.
pub struct Conversion<'a> {
    source: &'a dyn SceneSource,
    folder: PathBuf,
    options: ConvertOptions,
    journal: Journal,
    /// File of every scene that is written.
    index: BTreeMap<String, String>,
    /// Files with a scene that has changed.
    stale: BTreeSet<String>,
    pending: Vec<SceneRecord>,
    pending_keys: HashSet<String>,
    pending_bytes: u64,
    converted: Converted,
}

impl<'a> Conversion<'a> {
    /// Looks at `folder` and writes nothing. `left_out` is what opening `source` left out.
    ///
    /// # Errors
    /// [`DataError::BadIndex`] for a folder with other files, of other scenes or made with other options.
    pub fn open(
        source: &'a dyn SceneSource,
        left_out: &Ledger,
        folder: &Path,
        options: &ConvertOptions,
    ) -> Result<Self, DataError> {
        let journal = Journal::open(folder, &options.made_as())?;
        let mut conversion = Self {
            source,
            folder: folder.to_owned(),
            options: options.clone(),
            journal,
            index: BTreeMap::new(),
            stale: BTreeSet::new(),
            pending: Vec::new(),
            pending_keys: HashSet::new(),
            pending_bytes: 0,
            converted: Converted { left_out: left_out.clone(), ..Converted::default() },
        };
        conversion.look()?;
        Ok(conversion)
    }

    /// Takes up the scenes of the files that the journal knows.
    fn look(&mut self) -> Result<(), DataError> {
        let names: Vec<String> =
            self.journal.names().filter(|name| has_ending(name, "torch")).map(str::to_owned).collect();
        for name in names {
            let path = self.folder.join(&name);
            let tables: Vec<SceneTable> = ChunkTable::read(&path)?.scenes.into_values().collect();
            let changed: Vec<bool> =
                tables.par_iter().map(|table| self.is_changed(table, &path)).collect::<Result<_, _>>()?;
            let num_changed = changed.iter().filter(|changed| **changed).count();
            self.converted.num_changed += num_changed;
            if num_changed > 0 {
                self.stale.insert(name);
            } else {
                self.index.extend(tables.into_iter().map(|table| (table.key, name.clone())));
            }
        }
        self.converted.num_found = self.index.len();
        Ok(())
    }

    /// Whether a scene that is there differs from the source's.
    fn is_changed(&self, table: &SceneTable, path: &Path) -> Result<bool, DataError> {
        let key = &table.key;
        let Some(scene) = self.source.find(key).filter(|scene| self.source.key(*scene) == key) else {
            let what = format!("it holds scene {key}, which is not to be converted; choose another folder");
            return Err(DataError::BadIndex { what, path: path.to_owned() });
        };
        let now = self.source.timestamps(scene).and_then(|times| Ok((times, self.source.cameras(scene)?)));
        // What cannot be read any more is no reason to throw away what could be.
        let Ok((timestamps, cameras)) = now else { return Ok(false) };
        Ok(!table.is_of(path, &timestamps, &cameras)?)
    }

    /// Writes the scenes that are missing; one that cannot be read is left out, with the reason in the result and in
    /// `skipped.json`. `done` is told how many scenes are ready.
    ///
    /// # Errors
    /// [`DataError::Io`] from writing.
    pub fn run(mut self, mut done: impl FnMut(usize)) -> Result<Converted, DataError> {
        self.journal.begin()?;
        if !self.stale.is_empty() {
            // It names files that are about to go.
            self.journal.remove(INDEX)?;
        }
        for name in std::mem::take(&mut self.stale) {
            self.journal.remove(&name)?;
        }
        for scene in 0..self.source.num_scenes() {
            let key = self.source.key(scene);
            if !self.index.contains_key(key) && !self.pending_keys.contains(key) {
                match record(self.source, scene, self.options.encoding) {
                    Ok((record, num_encoded)) => self.add(record, num_encoded)?,
                    Err(error) => self.converted.left_out.skip(key, error.to_string()),
                }
            }
            done(self.index.len() + self.pending.len());
        }
        self.finish()
    }

    fn add(&mut self, record: SceneRecord, num_encoded: usize) -> Result<(), DataError> {
        let image_bytes = record.images.iter().map(|image| image.len() as u64).sum::<u64>();
        if let Err(what) = record.check() {
            self.converted.left_out.skip(record.key, what);
            return Ok(());
        }
        if self.options.to == ConvertTo::Scenes && !is_file_name(&record.key) {
            self.converted.left_out.skip(record.key, "its key is no name for a file; convert to chunks");
            return Ok(());
        }
        self.converted.num_frames += record.images.len();
        self.converted.num_encoded += num_encoded;
        self.converted.image_bytes += image_bytes;
        self.pending_bytes += image_bytes;
        self.pending_keys.insert(record.key.clone());
        self.pending.push(record);
        match self.options.to {
            ConvertTo::Chunks { target_bytes } if self.pending_bytes < target_bytes => Ok(()),
            _ => self.flush(),
        }
    }

    fn flush(&mut self) -> Result<(), DataError> {
        let scenes = std::mem::take(&mut self.pending);
        let Some(first) = scenes.first() else { return Ok(()) };
        let (name, bytes) = match self.options.to {
            ConvertTo::Chunks { .. } => {
                let name = self.free_name();
                let bytes = chunk_bytes(&self.folder.join(&name), &scenes)?;
                (name, bytes)
            }
            ConvertTo::Scenes => {
                let name = format!("{}.torch", first.key);
                let bytes = scene_file_bytes(&self.folder.join(&name), first)?;
                (name, bytes)
            }
        };
        self.journal.write(&name, &bytes)?;
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

    fn finish(mut self) -> Result<Converted, DataError> {
        self.flush()?;
        let is_chunks = self.options.to != ConvertTo::Scenes;
        let index = (is_chunks && !self.index.is_empty()).then(|| serde_json::to_vec_pretty(&self.index));
        let left_out = &self.converted.left_out;
        let skipped = left_out.has_gaps().then(|| serde_json::to_vec_pretty(left_out));
        for (name, text) in [(INDEX, index), (SKIPPED, skipped)] {
            let Some(text) = text else {
                // What an earlier run left out is there now.
                self.journal.remove(name)?;
                continue;
            };
            let path = self.folder.join(name);
            let text = text.map_err(|error| DataError::BadIndex { what: error.to_string(), path })?;
            self.journal.write(name, &text)?;
        }
        self.converted.num_scenes = self.index.len();
        Ok(self.converted)
    }
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

fn is_file_name(key: &str) -> bool {
    !key.is_empty() && !key.starts_with('.') && !key.contains(['/', '\\', '\0', ':', '\n'])
}

#[cfg(test)]
mod tests;
