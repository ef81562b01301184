//! Conversion of any source to pixelSplat's chunks or to one file per scene.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use clift_core::{StagedDir, is_empty_folder};
use rayon::prelude::*;
use serde::Serialize;

use crate::error::DataError;
use crate::image::codec::check_encoded;
use crate::scene_source::SceneSource;
use crate::skip_report::SkipReport;
use crate::sources::chunks::writer::{ChunkFill, SceneRecord, chunk_bytes, chunk_name, scene_file_bytes};
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
}

/// Result of a conversion.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ConversionReport {
    /// Number of scenes in the folder.
    pub num_scenes: usize,
    /// Number of written frames.
    pub num_frames: usize,
    /// Number of these frames that were encoded.
    pub num_encoded: usize,
    /// Bytes of the written images.
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

/// A conversion of the scenes of a source into a new folder, whose files appear when all are complete.
pub struct Converter<'a> {
    source: &'a dyn SceneSource,
    folder: PathBuf,
    options: ConvertOptions,
    /// File of every written scene, by key.
    index: BTreeMap<String, String>,
    num_files: usize,
    pending: Vec<SceneRecord>,
    fill: ChunkFill,
    report: ConversionReport,
}

impl<'a> Converter<'a> {
    /// Checks the output folder and writes nothing. `skipped` is the report of opening `source`.
    ///
    /// # Errors
    /// [`DataError::BadOutput`] for a folder with files.
    pub fn open(
        source: &'a dyn SceneSource,
        skipped: &SkipReport,
        folder: &Path,
        options: &ConvertOptions,
    ) -> Result<Self, DataError> {
        if !is_empty_folder(folder).map_err(DataError::io("reading the folder", folder))? {
            let what = "it is not empty; choose another folder".into();
            return Err(DataError::BadOutput { what, path: folder.to_owned() });
        }
        Ok(Self {
            source,
            folder: folder.to_owned(),
            options: options.clone(),
            index: BTreeMap::new(),
            num_files: 0,
            pending: Vec::new(),
            fill: ChunkFill::default(),
            report: ConversionReport { skipped: skipped.clone(), ..ConversionReport::default() },
        })
    }

    /// Writes all scenes, and calls `progress` with the number of finished scenes.
    ///
    /// Unreadable scenes are skipped, with the reason in the result and in `skipped.json`. Unreadable image files are
    /// copied, with the reason in the result and in `unreadable.json`.
    pub fn run(mut self, mut progress: impl FnMut(usize)) -> Result<ConversionReport, DataError> {
        let files = StagedDir::new(&self.folder).map_err(DataError::io("making the folder", &self.folder))?;
        for scene in 0..self.source.num_scenes() {
            match read_scene(self.source, scene, self.options.encoding, self.options.max_size) {
                Ok((record, num_encoded)) => self.add(record, num_encoded, files.path())?,
                Err(error) => self.report.skipped.skip(self.source.key(scene), error.to_string()),
            }
            progress(scene + 1);
        }
        self.flush(files.path())?;
        self.write_lists(files.path())?;
        files.commit().map_err(DataError::io("writing the folder", &self.folder))?;
        self.report.num_scenes = self.index.len();
        Ok(self.report)
    }

    fn add(&mut self, record: SceneRecord, num_encoded: usize, files: &Path) -> Result<(), DataError> {
        if let Err(what) = record.check() {
            self.report.skipped.skip(record.key, what);
            return Ok(());
        }
        if self.options.to == ConvertTo::Scenes && !is_file_name(&record.key) {
            self.report.skipped.skip(record.key, "its key is not a valid file name; convert to chunks");
            return Ok(());
        }
        if !self.fill.has_room(&record) {
            self.flush(files)?;
        }
        let unreadable = record.images.par_iter().enumerate();
        let unreadable: Vec<(usize, String)> =
            unreadable.filter_map(|(frame, bytes)| Some((frame, check_encoded(bytes).err()?))).collect();
        let image = |(frame, reason)| UnreadableImage { key: record.key.clone(), frame, reason };
        self.report.unreadable.extend(unreadable.into_iter().map(image));
        self.report.num_frames += record.images.len();
        self.report.num_encoded += num_encoded;
        self.report.image_bytes += record.image_bytes();
        self.fill.add(&record);
        self.pending.push(record);
        match self.options.to {
            ConvertTo::Chunks { target_bytes } if !self.fill.is_full(target_bytes) => Ok(()),
            _ => self.flush(files),
        }
    }

    /// Writes the pending scenes as a file.
    fn flush(&mut self, files: &Path) -> Result<(), DataError> {
        let scenes = std::mem::take(&mut self.pending);
        let Some(first) = scenes.first() else { return Ok(()) };
        let name = match self.options.to {
            ConvertTo::Chunks { .. } => chunk_name(self.num_files),
            ConvertTo::Scenes => format!("{}.torch", first.key),
        };
        let path = files.join(&name);
        let bytes = match self.options.to {
            ConvertTo::Chunks { .. } => chunk_bytes(&path, &scenes)?,
            ConvertTo::Scenes => scene_file_bytes(&path, first)?,
        };
        std::fs::write(&path, bytes).map_err(DataError::io("writing a file", &path))?;
        self.num_files += 1;
        self.index.extend(scenes.into_iter().map(|scene| (scene.key, name.clone())));
        self.fill = ChunkFill::default();
        Ok(())
    }

    /// Writes the index of chunks, and the lists of skipped scenes and unreadable images if there are some.
    fn write_lists(&mut self, files: &Path) -> Result<(), DataError> {
        let Self { index, report: ConversionReport { skipped, unreadable, .. }, .. } = self;
        let has_index = self.options.to != ConvertTo::Scenes && !index.is_empty();
        unreadable.sort_unstable();
        for (name, text) in [
            ("index.json", has_index.then(|| serde_json::to_vec_pretty(index))),
            ("skipped.json", skipped.has_skips().then(|| serde_json::to_vec_pretty(skipped))),
            ("unreadable.json", (!unreadable.is_empty()).then(|| serde_json::to_vec_pretty(unreadable))),
        ] {
            let path = files.join(name);
            let Some(text) = text else { continue };
            let text = text.map_err(|error| DataError::BadIndex { what: error.to_string(), path: path.clone() })?;
            std::fs::write(&path, text).map_err(DataError::io("writing a file", &path))?;
        }
        Ok(())
    }
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
