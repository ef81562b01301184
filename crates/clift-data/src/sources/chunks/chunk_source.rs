//! Scenes in the chunks of pixelSplat: `<root>/{train,test}/NNNNNN.torch` with an `index.json`.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use clift_core::{Camera, IntrinsicsNorm, RgbImage, widest_fov_deg};
use rayon::prelude::*;

use crate::error::DataError;
use crate::geometry::path_spread::far_cameras;
use crate::image::codec::decode_image;
use crate::scene_source::{SceneSource, Split};
use crate::skip_report::{SkipReport, note_on, plural};
use crate::sources::chunks::index::read_index;
use crate::sources::chunks::index_cache::{CachedChunk, CachedScene, ChunkIndexCache};
use crate::sources::chunks::table::{ChunkTable, SceneTable};
use crate::sources::filters::SceneFilters;
use crate::sources::keys::{DL3DV_PREFIX, find_by_name};

/// Chunks that are examined between two calls of the progress callback.
const CHUNKS_PER_CALL: usize = 64;

/// Largest number of chunks that are read at opening even without filters, so that what is odd in them is reported.
const MAX_READ_CHUNKS: usize = 8;

/// Progress callback: number of examined chunks, and of all.
pub type ScanProgress<'a> = &'a mut dyn FnMut(usize, usize);

/// A chunk file, whose table is read on the first use of one of its scenes.
struct Chunk {
    path: PathBuf,
    table: OnceLock<ChunkTable>,
    /// The entry in the chunk index cache, if the cache is used.
    cached: Option<CachedChunk>,
}

impl Chunk {
    /// Checks that the file exists.
    fn find(&self) -> Result<(), DataError> {
        let metadata = std::fs::metadata(&self.path)
            .map_err(DataError::io("opening a chunk that index.json lists", &self.path))?;
        if !metadata.is_file() {
            let what = if metadata.is_dir() { "a folder" } else { "a pipe or a device" };
            let what = format!("{what}, which index.json lists as a chunk");
            return Err(DataError::BadChunk { what, path: self.path.clone() });
        }
        Ok(())
    }

    /// Returns the cached entry if it is current, and otherwise reads the table and makes one.
    fn examine(&self, cached: Option<&CachedChunk>, needs_fov: bool) -> Result<CachedChunk, DataError> {
        match cached {
            Some(cached) if cached.is_current(&self.path, needs_fov) => Ok(cached.clone()),
            _ => CachedChunk::of(&self.path, || self.table(), needs_fov),
        }
    }

    /// Returns the keys of all scenes of the file, as far as they are in memory.
    fn keys(&self) -> Vec<&String> {
        match (&self.cached, self.table.get()) {
            (Some(cached), _) => cached.scenes.keys().collect(),
            (None, Some(table)) => table.scenes.keys().collect(),
            (None, None) => Vec::new(),
        }
    }

    fn table(&self) -> Result<&ChunkTable, DataError> {
        if let Some(table) = self.table.get() {
            return Ok(table);
        }
        // Two threads may read the same chunk at once; the first result is kept.
        let read = ChunkTable::read(&self.path)?;
        Ok(self.table.get_or_init(|| read))
    }
}

struct Entry {
    key: String,
    chunk: usize,
}

/// Scenes of one split of a chunked data set, sorted by key, with random access to single frames.
///
/// A used chunk keeps a table of 24 bytes per frame in memory (about 0.2 GiB for all of RealEstate10K). A frame, or the
/// cameras of a scene, take one read.
pub struct ChunkSource {
    chunks: Vec<Chunk>,
    scenes: Vec<Entry>,
    positions: HashMap<String, usize>,
    /// Skipped scenes: filtered and unreadable ones.
    pub report: SkipReport,
}

impl ChunkSource {
    /// Opens `<root>/<split>`. Without filters, only `index.json` is read; with filters, the table of every chunk.
    ///
    /// Scenes of missing chunks, and with filters unreadable scenes, are skipped and reported with the error.
    ///
    /// # Errors
    /// [`DataError::Io`] for a missing `index.json`, [`DataError::BadIndex`] for one that is not a map from keys to files
    /// beside it, [`DataError::BadConfig`] for invalid filters, and the error of the first chunk if every chunk fails.
    pub fn open(root: &Path, split: Split, filters: &SceneFilters) -> Result<Self, DataError> {
        let folder = root.join(split.to_string());
        let index = read_index(&folder.join("index.json"))?;
        let mut source = Self::of_index(&folder, &index, |_| true, filters, false, None)?;
        source.record_unlisted(&folder, &index);
        Ok(source)
    }

    /// Opens the scenes of `index`, a map from keys to files in `folder`, for which `kept` is true. With `reads_all`, the
    /// table of every chunk is read even without filters. `cache` is the path of the chunk index cache, with the progress
    /// callback of the scan that fills it.
    pub(crate) fn of_index(
        folder: &Path,
        index: &BTreeMap<String, String>,
        kept: impl Fn(&str) -> bool,
        filters: &SceneFilters,
        reads_all: bool,
        cache: Option<(&Path, ScanProgress<'_>)>,
    ) -> Result<Self, DataError> {
        filters.validate()?;
        let mut chunk_ids = BTreeMap::new();
        let mut chunks = Vec::new();
        let mut scenes = Vec::with_capacity(index.len());
        for (key, file) in index.iter().filter(|(key, _)| kept(key)) {
            let chunk = *chunk_ids.entry(file).or_insert_with_key(|file| {
                chunks.push(Chunk { path: folder.join(file), table: OnceLock::new(), cached: None });
                chunks.len() - 1
            });
            scenes.push(Entry { key: key.clone(), chunk });
        }
        let mut source = Self { chunks, report: SkipReport::new(scenes.len()), scenes, positions: HashMap::new() };
        if let Some((path, progress)) = cache.filter(|_| filters.is_any_set() && !reads_all) {
            source.scan(path, filters.max_fov_deg.is_some(), progress);
        }
        source.skip_scenes(filters, reads_all || filters.is_any_set())?;
        source.positions = source.scenes.iter().enumerate().map(|(i, entry)| (entry.key.clone(), i)).collect();
        Ok(source)
    }

    fn read_encoded(&self, scene: usize, frame: usize) -> Result<Vec<u8>, DataError> {
        let (path, table) = self.table(scene)?;
        let span = table.images.get(frame).ok_or_else(|| DataError::NoSuchFrame {
            key: table.key.clone(),
            frame,
            num_frames: table.images.len(),
        })?;
        span.read(path)
    }

    /// Examines all readable chunks, unchanged ones in the chunk index cache at `path`, and updates the cache.
    fn scan(&mut self, path: &Path, needs_fov: bool, progress: ScanProgress<'_>) {
        let name = |chunk: &Chunk| chunk.path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let cached = ChunkIndexCache::read(path).chunks;
        let examine = |chunk: &mut Chunk| chunk.cached = chunk.examine(cached.get(&name(chunk)), needs_fov).ok();
        let (mut done, total) = (0, self.chunks.len());
        for chunks in self.chunks.chunks_mut(CHUNKS_PER_CALL) {
            chunks.par_iter_mut().for_each(examine);
            done += chunks.len();
            progress(done, total);
        }
        let chunks = self.chunks.iter().filter_map(|chunk| Some((name(chunk), chunk.cached.clone()?)));
        // The other split may have its chunks in the same folder.
        let mut updated = cached.clone();
        updated.extend(chunks);
        if updated != cached {
            ChunkIndexCache::write(updated, path);
        }
    }

    /// Returns the cached values of a scene.
    fn cached(&self, scene: usize) -> Option<&CachedScene> {
        let Entry { key, chunk } = self.scenes.get(scene)?;
        self.chunks[*chunk].cached.as_ref()?.scenes.get(key)
    }

    /// Moves the scenes of failing chunks and the filtered scenes to the report.
    fn skip_scenes(&mut self, filters: &SceneFilters, reads_tables: bool) -> Result<(), DataError> {
        let open = |chunk: &Chunk| {
            chunk.find()?;
            if reads_tables && chunk.cached.is_none() { chunk.table().map(|_| ()) } else { Ok(()) }
        };
        let opened: Vec<Result<(), DataError>> = self.chunks.par_iter().map(open).collect();
        let failures: Vec<_> = opened.iter().map(|opened| opened.as_ref().err().map(ToString::to_string)).collect();
        if failures.iter().all(Option::is_some) {
            opened.into_iter().next().transpose()?;
        }
        let reason = |scene: usize| {
            let failure = failures[self.scenes[scene].chunk].clone();
            let filter = || {
                if reads_tables && self.cached(scene).is_none() {
                    self.table(scene)?;
                }
                self.reason_to_skip(scene, filters)
            };
            failure.or_else(|| filter().unwrap_or_else(|error| Some(error.to_string())))
        };
        let reasons: Vec<Option<String>> = (0..self.scenes.len()).into_par_iter().map(reason).collect();
        let scenes = std::mem::take(&mut self.scenes);
        for (entry, reason) in scenes.into_iter().zip(reasons) {
            match reason {
                Some(reason) => self.report.skip(entry.key, reason),
                None => self.scenes.push(entry),
            }
        }
        self.note_oddities();
        Ok(())
    }

    /// Reports unusable frames, scaled rotations, and chunks without checksums and time stamps: of the tables in memory, and
    /// of few chunks in any case. Only of few chunks, far cameras. An unreadable chunk is an error at its use.
    fn note_oddities(&mut self) {
        let is_small = self.chunks.len() <= MAX_READ_CHUNKS;
        let read = |chunk: &Chunk| if is_small { ChunkTable::read(&chunk.path).ok() } else { None };
        let is_unread = |chunk: &Chunk| chunk.table.get().is_none() && chunk.cached.is_none();
        let unread: Vec<_> =
            self.chunks.par_iter().map(|chunk| if is_unread(chunk) { read(chunk) } else { None }).collect();
        let table_of = |chunk: usize| self.chunks[chunk].table.get().or(unread[chunk].as_ref());
        let mut report = std::mem::take(&mut self.report);
        let (mut without_times, mut scaled, mut far, mut num_unchecked) = (Vec::new(), Vec::new(), Vec::new(), 0);
        for (index, Entry { key, chunk }) in self.scenes.iter().enumerate() {
            let table =
                table_of(*chunk).and_then(|table| table.scenes.get(key)).filter(|table| !table.images.is_empty());
            let unusable = table.map(|table| &table.unusable).or_else(|| Some(&self.cached(index)?.unusable));
            for (frame, reason) in unusable.into_iter().flatten() {
                report.skip_frame(key, frame.to_string(), reason);
            }
            without_times.extend(table.filter(|table| table.timestamps.is_none()).map(|_| key.clone()));
            scaled.extend(table.filter(|table| table.has_scale).map(|_| key.clone()));
            let cameras =
                table.filter(|_| is_small).and_then(|table| table.read_cameras(&self.chunks[*chunk].path).ok());
            let centres: Vec<_> = cameras.into_iter().flatten().map(|camera| camera.c2w.translation).collect();
            far.extend((!far_cameras(&centres).is_empty()).then(|| key.clone()));
        }
        for chunk in 0..self.chunks.len() {
            num_unchecked += usize::from(table_of(chunk).is_some_and(|table| table.lacks_checksums));
        }
        let what = "without time stamps as int64, which are counted 0, 1, ..";
        report.notes.extend(note_on(&without_times, what));
        report.notes.extend(note_on(&scaled, "with scaled rotations, whose scale was divided out"));
        report
            .notes
            .extend(note_on(&far, "with cameras far from the others, which set the scale if they are contexts"));
        if num_unchecked > 0 {
            let files = plural(num_unchecked, "file");
            report.notes.push(format!("{files} without checksums: damage would not be noticed"));
        }
        self.report = report;
    }

    /// Reports the scenes of chunks that `index` does not list. Only chunks whose keys are in memory are examined.
    pub(crate) fn record_unlisted(&mut self, folder: &Path, index: &BTreeMap<String, String>) {
        let (mut unlisted, mut elsewhere) = (BTreeSet::new(), BTreeSet::new());
        for chunk in &self.chunks {
            for key in chunk.keys() {
                match index.get(key) {
                    None => {
                        unlisted.insert(key.clone());
                    }
                    Some(file) if folder.join(file) != chunk.path => {
                        elsewhere.insert(key.clone());
                    }
                    Some(_) => {}
                }
            }
        }
        self.report.num_scenes += unlisted.len();
        for key in unlisted {
            self.report.skip(key, "in a chunk but not in its index.json");
        }
        let names: Vec<String> = elsewhere.into_iter().collect();
        let what = "also in chunks other than those of index.json, not used";
        self.report.notes.extend(note_on(&names, what));
    }

    fn reason_to_skip(&self, scene: usize, filters: &SceneFilters) -> Result<Option<String>, DataError> {
        let num_frames = if filters.min_frames > 0 { self.num_frames(scene)? } else { 0 };
        let fov_deg = match self.cached(scene) {
            Some(cached) => cached.fov_deg,
            None => self.table(scene).ok().and_then(|(_, table)| table.fov_deg),
        };
        filters.reason_to_skip(num_frames, || fov_deg.map_or_else(|| Ok(widest_fov_deg(&self.cameras(scene)?)), Ok))
    }

    fn table(&self, scene: usize) -> Result<(&Path, &SceneTable), DataError> {
        let num_scenes = self.scenes.len();
        let Entry { key, chunk } = self.scenes.get(scene).ok_or(DataError::NoSuchScene { scene, num_scenes })?;
        let chunk = &self.chunks[*chunk];
        let table = chunk.table()?;
        let scene = table.scenes.get(key).ok_or_else(|| DataError::BadChunk {
            what: format!("expected scene {key}, found {} other scenes", table.scenes.len()),
            path: chunk.path.clone(),
        })?;
        if scene.images.is_empty() {
            let reason =
                scene.unusable.first().map_or_else(String::new, |(_, reason)| format!(" that can be used: {reason}"));
            let what = format!("scene {key} has no frames{reason}");
            return Err(DataError::BadChunk { what, path: chunk.path.clone() });
        }
        Ok((&chunk.path, scene))
    }
}

impl SceneSource for ChunkSource {
    fn num_scenes(&self) -> usize {
        self.scenes.len()
    }

    fn key(&self, scene: usize) -> &str {
        &self.scenes[scene].key
    }

    fn find(&self, key: &str) -> Option<usize> {
        // The training chunks of DepthSplat prefix the keys; its indices do not.
        let prefixed = || self.positions.get(&format!("{DL3DV_PREFIX}{key}"));
        let by_name = || find_by_name(self.scenes.iter().map(|entry| entry.key.as_str()), key);
        self.positions.get(key).or_else(prefixed).copied().or_else(by_name)
    }

    fn num_frames(&self, scene: usize) -> Result<usize, DataError> {
        self.cached(scene).map_or_else(|| Ok(self.table(scene)?.1.images.len()), |cached| Ok(cached.num_frames))
    }

    fn timestamps(&self, scene: usize) -> Result<Vec<i64>, DataError> {
        let (path, table) = self.table(scene)?;
        table.read_timestamps(path)
    }

    fn url(&self, scene: usize) -> Result<String, DataError> {
        Ok(self.table(scene)?.1.url.clone())
    }

    fn cameras(&self, scene: usize) -> Result<Vec<Camera<IntrinsicsNorm>>, DataError> {
        let (path, table) = self.table(scene)?;
        table.read_cameras(path)
    }

    fn frame(&self, scene: usize, frame: usize) -> Result<RgbImage, DataError> {
        decode_image(&self.read_encoded(scene, frame)?, self.key(scene), frame)
    }

    fn encoded_frame(&self, scene: usize, frame: usize) -> Result<Option<Vec<u8>>, DataError> {
        self.read_encoded(scene, frame).map(Some)
    }
}

#[cfg(test)]
mod tests;
