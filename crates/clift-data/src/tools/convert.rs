//! Conversion of any source to pixelSplat's chunks or to one file per scene, resumable and with checksums.

use std::collections::{BTreeMap, BTreeSet, HashSet};
use std::path::{Path, PathBuf};

use rayon::prelude::*;
use serde::Serialize;

use crate::error::DataError;
use crate::files::listing::has_ending;
use crate::image::codec::check_encoded;
use crate::scene_source::SceneSource;
use crate::skip_report::{SkipReport, note_on};
use crate::sources::chunks::table::{ChunkTable, SceneTable};
use crate::sources::chunks::writer::{ChunkFill, SceneRecord, chunk_bytes, chunk_name, scene_file_bytes};
use crate::sources::test_scenes::KEPT_FOR_TESTING;
use crate::tools::checksums::{Checksums, INDEX, SKIPPED, UNREADABLE};
use crate::tools::export::{ImageEncoding, read_scene};

/// Longest key in bytes that names a file; file systems allow 255 with the ending.
const MAX_NAME_BYTES: usize = 200;

/// Format of the written files.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ConvertTo {
    /// Chunks `NNNNNN.torch` of many scenes, and `index.json`.
    Chunks {
        /// Bytes of images at which a chunk is closed.
        target_bytes: u64,
    },
    /// One file per scene, `<key>.torch`.
    Scenes,
}

/// Options of a conversion.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ConvertOptions {
    /// Format of the files.
    pub to: ConvertTo,
    /// Encoding of frames without an image file of their size: computed, undistorted and reduced ones. Other image files
    /// are copied unchanged.
    pub encoding: ImageEncoding,
    /// Largest side of an image in pixels; larger images are reduced.
    pub max_size: Option<usize>,
    /// Options with which the source was opened, on one line; empty for the defaults.
    pub opened_with: String,
}

impl ConvertOptions {
    /// Returns the options that two runs on one folder must share, on one line.
    fn made_as(&self) -> String {
        let form = match self.to {
            ConvertTo::Chunks { target_bytes } => format!("chunks of {target_bytes} bytes"),
            ConvertTo::Scenes => "a file per scene".into(),
        };
        let images = match self.encoding {
            ImageEncoding::Png => "PNG".into(),
            ImageEncoding::Jpeg(quality) => format!("JPEG of quality {quality}"),
        };
        let size = self.max_size.map_or(String::new(), |size| format!(", at most {size} pixels a side"));
        let with = if self.opened_with.is_empty() { "" } else { ", with " };
        format!("{form}, {images}{size}{with}{}", self.opened_with)
    }
}

/// Result of a conversion.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ConversionReport {
    /// Number of scenes in the folder.
    pub num_scenes: usize,
    /// Number of scenes found complete from an earlier run.
    pub num_found: usize,
    /// Number of scenes found with other cameras, time stamps or frame counts, and written again.
    pub num_changed: usize,
    /// Number of frames written by this run.
    pub num_frames: usize,
    /// Number of these frames that were encoded.
    pub num_encoded: usize,
    /// Bytes of the images written by this run.
    pub image_bytes: u64,
    /// Frames of the folder whose image file cannot be read. They are copied, because evaluation indices count frames.
    pub unreadable: Vec<UnreadableImage>,
    /// Scenes and frames skipped when the source was opened, and unreadable scenes.
    pub skipped: SkipReport,
}

/// A copied image file that is not a complete JPEG or PNG.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
pub struct UnreadableImage {
    /// Scene key.
    pub key: String,
    /// Frame index in the scene.
    pub frame: usize,
    /// Reason.
    pub reason: String,
}

/// State of a scene found in the folder, compared with the source.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    Same,
    Changed,
    /// Skipped when the source was opened.
    Unreadable,
}

/// A file of the folder with the states of its scenes and its unreadable images.
type Scanned = (String, Vec<(String, State)>, Vec<UnreadableImage>);

/// A conversion of the scenes of a source into a folder.
///
/// A file under its final name is always complete, and `SHA256SUMS` (for `sha256sum -c`) has its checksum. A run on a
/// folder of an earlier run verifies all checksums and keeps the files whose scenes have the cameras, time stamps and
/// frame counts of the source; it writes the others again. Images are not compared.
pub struct Converter<'a> {
    source: &'a dyn SceneSource,
    folder: PathBuf,
    options: ConvertOptions,
    checksums: Checksums,
    /// File of every complete scene, by key.
    index: BTreeMap<String, String>,
    /// Files with a changed scene.
    stale: BTreeSet<String>,
    /// Complete scenes that were skipped when the source was opened.
    unreadable: BTreeSet<String>,
    pending: Vec<SceneRecord>,
    fill: ChunkFill,
    report: ConversionReport,
}

impl<'a> Converter<'a> {
    /// Reads the state of `folder` and writes nothing. `skipped` is the report of opening `source`.
    ///
    /// # Errors
    /// [`DataError::BadOutput`] for a folder with other files, with other scenes, and of a conversion with other options.
    pub fn open(
        source: &'a dyn SceneSource,
        skipped: &SkipReport,
        folder: &Path,
        options: &ConvertOptions,
    ) -> Result<Self, DataError> {
        let checksums = Checksums::open(folder, &options.made_as())?;
        let mut converter = Self {
            source,
            folder: folder.to_owned(),
            options: options.clone(),
            checksums,
            index: BTreeMap::new(),
            stale: BTreeSet::new(),
            unreadable: BTreeSet::new(),
            pending: Vec::new(),
            fill: ChunkFill::default(),
            report: ConversionReport { skipped: skipped.clone(), ..ConversionReport::default() },
        };
        converter.scan()?;
        Ok(converter)
    }

    /// Compares the scenes of the complete files with the source.
    fn scan(&mut self) -> Result<(), DataError> {
        // Scenes reserved for testing are readable.
        let unreadable = self.report.skipped.skips.iter().filter(|skip| skip.reason != KEPT_FOR_TESTING);
        let unreadable: HashSet<&str> = unreadable.map(|skip| skip.key.as_str()).collect();
        let names: Vec<&str> = self.checksums.names().filter(|name| has_ending(name, "torch")).collect();
        let scan = |name: &str| {
            let path = self.folder.join(name);
            let tables: Vec<SceneTable> = ChunkTable::read(&path)?.scenes.into_values().collect();
            let states = tables.iter().map(|table| self.state(table, &path, &unreadable));
            let states = states.collect::<Result<Vec<State>, DataError>>()?;
            let images = tables.iter().flat_map(|table| unreadable_images(&table.key, table.unreadable_images(&path)));
            let images = images.collect();
            let scenes = tables.into_iter().map(|table| table.key).zip(states).collect();
            Ok((name.to_owned(), scenes, images))
        };
        let files: Vec<Scanned> = names.into_par_iter().map(scan).collect::<Result<_, DataError>>()?;
        for (name, scenes, images) in files {
            let num_changed = scenes.iter().filter(|(_, state)| *state == State::Changed).count();
            self.report.num_changed += num_changed;
            if num_changed > 0 {
                self.stale.insert(name);
                continue;
            }
            self.report.unreadable.extend(images);
            for (key, state) in scenes {
                if state == State::Unreadable {
                    self.unreadable.insert(key.clone());
                }
                self.index.insert(key, name.clone());
            }
        }
        self.report.num_found = self.index.len();
        Ok(())
    }

    /// Compares a scene of the folder with the source. `unreadable` are the keys skipped when the source was opened.
    fn state(&self, table: &SceneTable, path: &Path, unreadable: &HashSet<&str>) -> Result<State, DataError> {
        let key = &table.key;
        let Some(scene) = self.source.find(key).filter(|scene| self.source.key(*scene) == key) else {
            if unreadable.contains(key.as_str()) {
                return Ok(State::Unreadable);
            }
            let what = format!("it holds scene {key}, which the source does not have; choose another folder");
            return Err(DataError::BadOutput { what, path: path.to_owned() });
        };
        let now = self.source.timestamps(scene).and_then(|times| Ok((times, self.source.cameras(scene)?)));
        // A converted scene that the source can no longer read is kept.
        let Ok((timestamps, cameras)) = now else { return Ok(State::Same) };
        Ok(if table.is_of(path, &timestamps, &cameras)? { State::Same } else { State::Changed })
    }

    /// Writes the missing scenes, and calls `progress` with the number of finished scenes.
    ///
    /// Unreadable scenes are skipped, with the reason in the result and in `skipped.json`. Unreadable image files are
    /// copied, with the reason in the result and in `unreadable.json`.
    ///
    /// # Errors
    /// [`DataError::Io`] from writing.
    pub fn run(mut self, mut progress: impl FnMut(usize)) -> Result<ConversionReport, DataError> {
        self.checksums.begin()?;
        let stale = std::mem::take(&mut self.stale);
        // The index goes before the files that it names, and is written last.
        self.checksums.remove_all([INDEX])?;
        self.checksums.remove_all(stale.iter().map(String::as_str))?;
        for scene in 0..self.source.num_scenes() {
            let key = self.source.key(scene);
            if !self.index.contains_key(key) && self.pending.iter().all(|scene| scene.key != key) {
                match read_scene(self.source, scene, self.options.encoding, self.options.max_size) {
                    Ok((record, num_encoded)) => self.add(record, num_encoded)?,
                    Err(error) => self.report.skipped.skip(key, error.to_string()),
                }
            }
            progress(self.index.len() + self.pending.len());
        }
        self.finish()
    }

    fn add(&mut self, record: SceneRecord, num_encoded: usize) -> Result<(), DataError> {
        if let Err(what) = record.check() {
            self.report.skipped.skip(record.key, what);
            return Ok(());
        }
        if self.options.to == ConvertTo::Scenes && !is_file_name(&record.key) {
            self.report.skipped.skip(record.key, "its key is not a valid file name; convert to chunks");
            return Ok(());
        }
        if !self.fill.has_room(&record) {
            self.flush()?;
        }
        let unreadable = record.images.par_iter().enumerate();
        let unreadable = unreadable.filter_map(|(frame, bytes)| Some((frame, check_encoded(bytes).err()?))).collect();
        self.report.unreadable.extend(unreadable_images(&record.key, unreadable));
        self.report.num_frames += record.images.len();
        self.report.num_encoded += num_encoded;
        self.report.image_bytes += record.image_bytes();
        self.fill.add(&record);
        self.pending.push(record);
        match self.options.to {
            ConvertTo::Chunks { target_bytes } if !self.fill.is_full(target_bytes) => Ok(()),
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
        self.checksums.write(&name, &bytes)?;
        self.index.extend(scenes.into_iter().map(|scene| (scene.key, name.clone())));
        self.fill = ChunkFill::default();
        Ok(())
    }

    fn free_name(&self) -> String {
        let used: HashSet<&String> = self.index.values().collect();
        // One of `used.len() + 1` names is free.
        (0..=used.len()).map(chunk_name).find(|name| !used.contains(name)).unwrap_or_default()
    }

    fn finish(mut self) -> Result<ConversionReport, DataError> {
        self.flush()?;
        let names: Vec<&String> = self.unreadable.iter().collect();
        let skipped = &mut self.report.skipped;
        skipped.notes.extend(note_on(&names, "unreadable now, kept as converted before"));
        skipped.skips.retain(|skip| !self.unreadable.contains(&skip.key));
        let is_chunks = self.options.to != ConvertTo::Scenes;
        let index = (is_chunks && !self.index.is_empty()).then(|| serde_json::to_vec_pretty(&self.index));
        let skipped = &self.report.skipped;
        let skipped = skipped.has_skips().then(|| serde_json::to_vec_pretty(skipped));
        self.report.unreadable.sort_unstable();
        let unreadable = &self.report.unreadable;
        let unreadable = (!unreadable.is_empty()).then(|| serde_json::to_vec_pretty(unreadable));
        for (name, text) in [(INDEX, index), (SKIPPED, skipped), (UNREADABLE, unreadable)] {
            let Some(text) = text else {
                // The list of an earlier run is outdated.
                self.checksums.remove_all([name])?;
                continue;
            };
            let path = self.folder.join(name);
            let text = text.map_err(|error| DataError::BadIndex { what: error.to_string(), path })?;
            self.checksums.write(name, &text)?;
        }
        self.report.num_scenes = self.index.len();
        Ok(self.report)
    }
}

fn unreadable_images(key: &str, frames: Vec<(usize, String)>) -> impl Iterator<Item = UnreadableImage> {
    frames.into_iter().map(|(frame, reason)| UnreadableImage { key: key.to_owned(), frame, reason })
}

/// Returns whether a key is a valid file name on all operating systems.
fn is_file_name(key: &str) -> bool {
    !key.is_empty()
        && !key.starts_with('.')
        && key.len() <= MAX_NAME_BYTES
        && !key.contains(['/', '\\', '\0', ':', '\n', '*', '?', '"', '<', '>', '|'])
}

#[cfg(test)]
mod tests;
