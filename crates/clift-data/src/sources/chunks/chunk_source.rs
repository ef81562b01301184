//! Scenes in the chunks of pixelSplat: `<root>/{train,test}/NNNNNN.torch` with an `index.json`.

use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use clift_core::{Camera, IntrinsicsNorm, RgbImage, first_few, plural, widest_fov_deg};
use rayon::prelude::*;

use crate::error::DataError;
use crate::image::codec::decode_image;
use crate::scene_source::{SceneSource, Split};
use crate::skip_report::SkipReport;
use crate::sources::chunks::index::read_index;
use crate::sources::chunks::index_cache::{CachedChunk, CachedScene, ChunkIndexCache};
use crate::sources::chunks::table::{CHUNKS_PER_CALL, ChunkTable, ODDITIES, ScanProgress, SceneTable};
use crate::sources::filters::SceneFilters;
use crate::sources::keys::{DL3DV_PREFIX, find_by_name};

/// Largest number of chunks that are read at opening even without filters, so that unusable frames are reported.
const MAX_READ_CHUNKS: usize = 8;

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
        Self::of_index(&folder, &read_index(&folder.join("index.json"))?, filters, false, None, &mut |_, _| ())
    }

    /// Opens the scenes of `index`, a map from keys to files in `folder`. With `reads_all`, the table of every chunk is read
    /// even without filters. `cache` is the path of the chunk index cache. `progress` is called while tables are read.
    pub(crate) fn of_index(
        folder: &Path,
        index: &BTreeMap<String, String>,
        filters: &SceneFilters,
        reads_all: bool,
        cache: Option<&Path>,
        progress: ScanProgress<'_>,
    ) -> Result<Self, DataError> {
        filters.validate()?;
        let mut chunk_ids = BTreeMap::new();
        let mut chunks = Vec::new();
        let mut scenes = Vec::with_capacity(index.len());
        for (key, file) in index {
            let chunk = *chunk_ids.entry(file).or_insert_with_key(|file| {
                chunks.push(Chunk { path: folder.join(file), table: OnceLock::new(), cached: None });
                chunks.len() - 1
            });
            scenes.push(Entry { key: key.clone(), chunk });
        }
        let reads_tables = reads_all || filters.is_any_set();
        let is_scanned = reads_tables || chunks.len() <= MAX_READ_CHUNKS;
        let mut source = Self { chunks, report: SkipReport::new(scenes.len()), scenes, positions: HashMap::new() };
        if is_scanned {
            let cache = cache.filter(|_| filters.is_any_set() && !reads_all);
            source.scan(cache, filters.max_fov_deg.is_some(), progress);
        }
        source.skip_scenes(filters, reads_tables)?;
        source.positions = source.scenes.iter().enumerate().map(|(i, entry)| (entry.key.clone(), i)).collect();
        Ok(source)
    }

    fn read_encoded(&self, scene: usize, frame: usize) -> Result<Vec<u8>, DataError> {
        let (path, SceneTable { key, images, .. }) = self.table(scene)?;
        let missing = || DataError::NoSuchFrame { key: key.clone(), frame, num_frames: images.len() };
        images.get(frame).ok_or_else(missing)?.read(path)
    }

    /// Reads the tables of all readable chunks; with a chunk index cache at `path`, of changed ones, and updates the cache. An
    /// unreadable chunk is an error at its use.
    fn scan(&mut self, path: Option<&Path>, needs_fov: bool, progress: ScanProgress<'_>) {
        let name = |chunk: &Chunk| chunk.path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let cached = path.map(ChunkIndexCache::read).unwrap_or_default().chunks;
        let examine = |chunk: &mut Chunk| {
            if path.is_none() {
                return drop(chunk.table());
            }
            let current = cached.get(&name(chunk)).filter(|cached| cached.is_current(&chunk.path, needs_fov)).cloned();
            chunk.cached = current.or_else(|| CachedChunk::of(&chunk.path, || chunk.table(), needs_fov).ok());
        };
        let (mut done, total) = (0, self.chunks.len());
        for chunks in self.chunks.chunks_mut(CHUNKS_PER_CALL) {
            chunks.par_iter_mut().for_each(examine);
            done += chunks.len();
            progress(done, total);
        }
        let Some(path) = path else { return };
        // The other split may have its chunks in the same folder.
        let mut updated = cached.clone();
        updated.extend(self.chunks.iter().filter_map(|chunk| Some((name(chunk), chunk.cached.clone()?))));
        if updated != cached {
            ChunkIndexCache::write(updated, path);
        }
    }

    /// Returns the cached values of a scene.
    fn cached(&self, scene: usize) -> Option<&CachedScene> {
        let Entry { key, chunk } = self.scenes.get(scene)?;
        self.chunks[*chunk].cached.as_ref()?.scenes.get(key)
    }

    /// Moves the scenes of failing chunks and the filtered scenes to the report, which names unusable frames, too.
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
        let filter = |scene: usize| {
            if !reads_tables {
                return Ok(None);
            }
            if let Some(CachedScene { num_frames, fov_deg, .. }) = self.cached(scene) {
                return filters.reason_to_skip(*num_frames, || Ok(fov_deg.unwrap_or_default()));
            }
            let (path, table) = self.table(scene)?;
            let fov_deg = || table.fov_deg.map_or_else(|| Ok(widest_fov_deg(&table.read_cameras(path)?)), Ok);
            filters.reason_to_skip(table.images.len(), fov_deg)
        };
        let reason = |scene: usize| {
            let failure = failures[self.scenes[scene].chunk].clone();
            failure.or_else(|| filter(scene).unwrap_or_else(|error| Some(error.to_string())))
        };
        let reasons: Vec<Option<String>> = (0..self.scenes.len()).into_par_iter().map(reason).collect();
        let (scenes, mut odd) = (std::mem::take(&mut self.scenes), ODDITIES.map(|what| (what, Vec::new())));
        for (entry, reason) in scenes.into_iter().zip(reasons) {
            if let Some(reason) = reason {
                self.report.skip(entry.key, reason);
                continue;
            }
            let chunk = &self.chunks[entry.chunk];
            let table = chunk.table.get().and_then(|table| table.scenes.get(&entry.key));
            let cached = || Some(&chunk.cached.as_ref()?.scenes.get(&entry.key)?.unusable);
            for (frame, reason) in table.map(|table| &table.unusable).or_else(cached).into_iter().flatten() {
                self.report.skip_frame(&entry.key, frame.to_string(), reason);
            }
            for ((_, keys), is_odd) in odd.iter_mut().zip(table.into_iter().flat_map(|table| table.oddities)) {
                keys.extend(is_odd.then(|| entry.key.clone()));
            }
            self.scenes.push(entry);
        }
        for (what, keys) in odd.iter().filter(|(_, keys)| !keys.is_empty()) {
            self.report.notes.push(format!("{} {what} ({})", plural(keys.len(), "scene"), first_few(keys)));
        }
        let tables = self.chunks.iter().filter_map(|chunk| chunk.table.get());
        let num_unchecked = tables.filter(|table| table.lacks_checksums).count();
        if num_unchecked > 0 {
            let files = plural(num_unchecked, "file");
            self.report.notes.push(format!("{files} without checksums: damage would not be noticed"));
        }
        Ok(())
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
