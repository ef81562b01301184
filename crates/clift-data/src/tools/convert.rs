//! Any source as pixelSplat's chunks or as one file per scene, resumable and with checksums.

use std::collections::{BTreeMap, BTreeSet, HashSet};
use std::path::{Path, PathBuf};

use rayon::prelude::*;

use crate::error::DataError;
use crate::files::listing::has_ending;
use crate::scene_source::SceneSource;
use crate::skip_report::{SkipReport, SkippedScene, first_few, plural};
use crate::sources::chunks::index::read_index;
use crate::sources::chunks::table::{ChunkTable, SceneTable};
use crate::sources::chunks::writer::{ChunkFill, SceneRecord, chunk_bytes, chunk_name, scene_file_bytes};
use crate::sources::test_scenes::KEPT_FOR_TESTING;
use crate::tools::checksums::{Checksums, INDEX, SKIPPED};
use crate::tools::export::ImageEncoding;

/// Longest key that names a file: file systems take 255 bytes, the ending included.
const MAX_NAME_BYTES: usize = 200;

/// What is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ConvertTo {
    /// `NNNNNN.torch` files of many scenes, each closed at so many bytes of images, and `index.json`.
    Chunks {
        /// Bytes of images.
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
    pub encoding: ImageEncoding,
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
        let images = match self.encoding {
            ImageEncoding::Png => "PNG".into(),
            ImageEncoding::Jpeg(quality) => format!("JPEG of quality {quality}"),
        };
        let with = if self.opened_with.is_empty() { "" } else { ", with " };
        format!("{form}, {images}{with}{}", self.opened_with)
    }
}

/// What was written.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ConversionReport {
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
    /// Bytes of the images written now.
    pub image_bytes: u64,
    /// What opening the source left out, and scenes that could not be read.
    pub left_out: SkipReport,
}

/// Opens a [`Converter`] and runs it.
///
/// # Errors
/// As both.
pub fn convert(
    source: &dyn SceneSource,
    left_out: &SkipReport,
    folder: &Path,
    options: &ConvertOptions,
    done: impl FnMut(usize),
) -> Result<ConversionReport, DataError> {
    Converter::open(source, left_out, folder, options)?.run(done)
}

/// What a scene that is there is to the source's.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    Same,
    Changed,
    /// The source had it.
    Unreadable,
}

/// A folder that is to receive the scenes of a source.
///
/// Every file appears under its name only when it is complete, its SHA-256 in `SHA256SUMS`, which `sha256sum -c`
/// reads. In a folder that was not finished, files are kept whose sums still hold and whose scenes still have the
/// cameras, time stamps and numbers of frames of the source, and the rest is made; in one that was finished, all sums
/// are verified. Pictures are not compared.
pub struct Converter<'a> {
    source: &'a dyn SceneSource,
    folder: PathBuf,
    options: ConvertOptions,
    checksums: Checksums,
    /// File of every scene that is written.
    index: BTreeMap<String, String>,
    /// Files with a scene that has changed.
    stale: BTreeSet<String>,
    /// Scenes of files that stay which opening the source has left out.
    unreadable: BTreeSet<String>,
    pending: Vec<SceneRecord>,
    pending_keys: HashSet<String>,
    fill: ChunkFill,
    converted: ConversionReport,
}

impl<'a> Converter<'a> {
    /// Looks at `folder` and writes nothing. `left_out` is what opening `source` left out.
    ///
    /// # Errors
    /// [`DataError::BadIndex`] for a folder with other files, of other scenes or made with other options.
    pub fn open(
        source: &'a dyn SceneSource,
        left_out: &SkipReport,
        folder: &Path,
        options: &ConvertOptions,
    ) -> Result<Self, DataError> {
        let checksums = Checksums::open(folder, &options.made_as())?;
        let mut conversion = Self {
            source,
            folder: folder.to_owned(),
            options: options.clone(),
            checksums,
            index: BTreeMap::new(),
            stale: BTreeSet::new(),
            unreadable: BTreeSet::new(),
            pending: Vec::new(),
            pending_keys: HashSet::new(),
            fill: ChunkFill::default(),
            converted: ConversionReport { left_out: left_out.clone(), ..ConversionReport::default() },
        };
        conversion.look()?;
        Ok(conversion)
    }

    /// Takes up the scenes of the files that the checksums knows.
    fn look(&mut self) -> Result<(), DataError> {
        let unreadable: HashSet<&str> =
            self.converted.left_out.skips.iter().filter_map(SkippedScene::unreadable).collect();
        let names: Vec<&str> = self.checksums.names().filter(|name| has_ending(name, "torch")).collect();
        let look = |name: &str| {
            let path = self.folder.join(name);
            let tables: Vec<SceneTable> = ChunkTable::read(&path)?.scenes.into_values().collect();
            let states = tables.iter().map(|table| self.state(table, &path, &unreadable));
            let states = states.collect::<Result<Vec<State>, DataError>>()?;
            let scenes = tables.into_iter().map(|table| table.key).zip(states).collect();
            Ok((name.to_owned(), scenes))
        };
        let looked: Vec<(String, Vec<(String, State)>)> =
            names.into_par_iter().map(look).collect::<Result<_, DataError>>()?;
        for (name, scenes) in looked {
            let num_changed = scenes.iter().filter(|(_, state)| *state == State::Changed).count();
            self.converted.num_changed += num_changed;
            if num_changed > 0 {
                self.stale.insert(name);
                continue;
            }
            for (key, state) in scenes {
                if state == State::Unreadable {
                    self.unreadable.insert(key.clone());
                }
                self.index.insert(key, name.clone());
            }
        }
        self.converted.num_found = self.index.len();
        Ok(())
    }

    /// How a scene that is there compares to the source's. `unreadable` are those that opening the source left out.
    fn state(&self, table: &SceneTable, path: &Path, unreadable: &HashSet<&str>) -> Result<State, DataError> {
        let key = &table.key;
        let Some(scene) = self.source.find(key).filter(|scene| self.source.key(*scene) == key) else {
            if unreadable.contains(key.as_str()) {
                return Ok(State::Unreadable);
            }
            let what = format!("it holds scene {key}, which is not to be converted; choose another folder");
            return Err(DataError::BadIndex { what, path: path.to_owned() });
        };
        let now = self.source.timestamps(scene).and_then(|times| Ok((times, self.source.cameras(scene)?)));
        // What cannot be read any more is no reason to throw away what could be.
        let Ok((timestamps, cameras)) = now else { return Ok(State::Same) };
        Ok(if table.is_of(path, &timestamps, &cameras)? { State::Same } else { State::Changed })
    }

    /// Writes the scenes that are missing; one that cannot be read is left out, with the reason in the result and in
    /// `skipped.json`. `done` is told how many scenes are ready.
    ///
    /// # Errors
    /// [`DataError::Io`] from writing.
    pub fn run(mut self, mut done: impl FnMut(usize)) -> Result<ConversionReport, DataError> {
        self.checksums.begin()?;
        let stale = std::mem::take(&mut self.stale);
        if !stale.is_empty() || self.index_names_others() {
            // It names files that are about to go, or are gone.
            self.checksums.remove_all([INDEX])?;
        }
        self.checksums.remove_all(stale.iter().map(String::as_str))?;
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

    /// Whether the index that is there names files that are not.
    fn index_names_others(&self) -> bool {
        let there: HashSet<&str> = self.checksums.names().collect();
        let is_other = |index: BTreeMap<String, String>| index.values().any(|file| !there.contains(file.as_str()));
        there.contains(INDEX) && read_index(&self.folder.join(INDEX)).map_or(true, is_other)
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
        if !self.fill.has_room(&record) {
            self.flush()?;
        }
        self.converted.num_frames += record.images.len();
        self.converted.num_encoded += num_encoded;
        self.converted.image_bytes += image_bytes;
        self.fill.add(&record);
        self.pending_keys.insert(record.key.clone());
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
        self.pending_keys.clear();
        self.fill = ChunkFill::default();
        Ok(())
    }

    /// The first chunk name that is not in use.
    fn free_name(&self) -> String {
        let used: HashSet<&String> = self.index.values().collect();
        // Of one name more than there are files, one is free.
        (0..=used.len()).map(chunk_name).find(|name| !used.contains(name)).unwrap_or_default()
    }

    fn finish(mut self) -> Result<ConversionReport, DataError> {
        self.flush()?;
        if !self.unreadable.is_empty() {
            let names: Vec<&String> = self.unreadable.iter().collect();
            let scenes = plural(names.len(), "scene");
            let left_out = &mut self.converted.left_out;
            left_out
                .notes
                .push(format!("{scenes} could not be read again, kept as converted before ({})", first_few(&names)));
            left_out.skips.retain(|skip| !self.unreadable.contains(&skip.key));
        }
        let is_chunks = self.options.to != ConvertTo::Scenes;
        let index = (is_chunks && !self.index.is_empty()).then(|| serde_json::to_vec_pretty(&self.index));
        let left_out = &self.converted.left_out;
        let skipped = left_out.has_skips().then(|| serde_json::to_vec_pretty(left_out));
        for (name, text) in [(INDEX, index), (SKIPPED, skipped)] {
            let Some(text) = text else {
                // What an earlier run left out is there now.
                self.checksums.remove_all([name])?;
                continue;
            };
            let path = self.folder.join(name);
            let text = text.map_err(|error| DataError::BadIndex { what: error.to_string(), path })?;
            self.checksums.write(name, &text)?;
        }
        self.converted.num_scenes = self.index.len();
        Ok(self.converted)
    }
}

impl SkippedScene {
    /// The key of a scene that would be used if it could be.
    fn unreadable(&self) -> Option<&str> {
        (!self.reason.starts_with(KEPT_FOR_TESTING)).then_some(&self.key)
    }
}

/// Reads a scene; also says how many of its frames had to be encoded.
fn record(source: &dyn SceneSource, scene: usize, encoding: ImageEncoding) -> Result<(SceneRecord, usize), DataError> {
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
    !key.is_empty()
        && !key.starts_with('.')
        && key.len() <= MAX_NAME_BYTES
        && !key.contains(['/', '\\', '\0', ':', '\n', '*', '?', '"', '<', '>', '|'])
}

#[cfg(test)]
mod tests;
