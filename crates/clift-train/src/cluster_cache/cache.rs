//! The finished cluster cache of a run.
//!
//! A folder with `index.json` (entries, encoder, settings) and `clusters.bin` (per entry the cluster of every token and the
//! token of every cluster, little-endian u16).

use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use clift_core::{PoseRotation, PoseScale};
use clift_data::{FileOptions, SceneFilters, SkipReport, SourceKind, SyntheticConfig, ViewSampler};
use clift_model::SceneClusters;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::config::config::{ClustersConfig, Config, MAX_TOKENS};
use crate::error::TrainError;
use crate::version::check_version;

pub(crate) const VERSION: u32 = 2;

/// One clustered context set of a scene.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CacheEntry {
    pub key: String,
    /// Frames of the contexts.
    pub context: Vec<usize>,
    pub num_tokens: usize,
    pub num_storage_tokens: usize,
    pub offset_bytes: u64,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct CacheIndex {
    pub version: u32,
    /// Hash of the encoder's weights.
    pub encoder: String,
    pub settings: CacheSettings,
    pub skipped: SkipReport,
    pub entries: Vec<CacheEntry>,
}

/// Settings that determine the clusters, besides the encoder.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct CacheSettings {
    seed: u64,
    source: SourceKind,
    root: Option<PathBuf>,
    files: FileOptions,
    synthetic: SyntheticConfig,
    width: usize,
    height: usize,
    pose_rotation: PoseRotation,
    pose_scale: PoseScale,
    filters: SceneFilters,
    views: ViewSampler,
    clusters: ClustersConfig,
}

impl CacheSettings {
    pub fn new(config: &Config) -> Self {
        let data = config.data.clone();
        Self {
            seed: config.seed,
            source: data.source,
            root: data.root,
            files: data.files,
            synthetic: data.synthetic,
            width: data.width,
            height: data.height,
            pose_rotation: data.pose_rotation,
            pose_scale: data.pose_scale,
            filters: data.filters,
            views: data.views,
            clusters: config.clusters.clone(),
        }
    }
}

impl CacheEntry {
    /// Whether a scene can have these numbers of tokens and clusters. Checked before they are added or allocated.
    pub(crate) fn is_possible(&self) -> bool {
        (1..=MAX_TOKENS).contains(&self.num_tokens) && (1..=self.num_tokens).contains(&self.num_storage_tokens)
    }

    /// Returns the size of the entry in `clusters.bin`.
    pub(crate) fn num_bytes(&self) -> u64 {
        (self.num_tokens as u64).saturating_add(self.num_storage_tokens as u64).saturating_mul(2)
    }
}

/// An open cluster cache.
#[derive(Debug)]
pub struct ClusterCache {
    folder: PathBuf,
    index: CacheIndex,
}

impl ClusterCache {
    /// Opens the cache of a run.
    ///
    /// # Errors
    /// [`TrainError::StaleClusters`] if the cache was built with another encoder or other settings, [`TrainError::BadFile`] if
    /// the files are damaged.
    pub fn open(folder: &Path, config: &Config, encoder: &str) -> Result<Self, TrainError> {
        let path = folder.join("index.json");
        let text = std::fs::read(&path).map_err(TrainError::io("reading the cluster cache", &path))?;
        let index: Value = serde_json::from_slice(&text).map_err(TrainError::bad_file("cluster cache", &path))?;
        let stale = |reason: String| TrainError::StaleClusters { reason, path: folder.into() };
        check_version(&index, VERSION).map_err(stale)?;
        let index: CacheIndex = serde_json::from_value(index).map_err(TrainError::bad_file("cluster cache", &path))?;
        if index.encoder != encoder {
            let short = |hash: &str| hash.chars().take(12).collect::<String>();
            let reason =
                format!("its tokens are of encoder {}, the run's is {}", short(&index.encoder), short(encoder));
            return Err(stale(reason));
        }
        if index.settings != CacheSettings::new(config) {
            return Err(stale("it was built with other settings than those of this run".into()));
        }
        if let Some(entry) = index.entries.iter().find(|entry| !entry.is_possible()) {
            let CacheEntry { key, num_tokens, num_storage_tokens, .. } = entry;
            let reason = format!("scene {key} has {num_storage_tokens} clusters of {num_tokens} tokens");
            return Err(TrainError::BadFile { what: "cluster cache", reason, path });
        }
        let data = folder.join("clusters.bin");
        let found = std::fs::metadata(&data).map_err(TrainError::io("opening the cluster cache", &data))?.len();
        let expected: u64 = index.entries.iter().map(CacheEntry::num_bytes).sum();
        if found != expected {
            let reason = format!("{found} bytes, {expected} expected");
            return Err(TrainError::BadFile { what: "cluster cache", reason, path: data });
        }
        Ok(Self { folder: folder.into(), index })
    }

    /// Returns the clustered context sets.
    pub fn entries(&self) -> &[CacheEntry] {
        &self.index.entries
    }

    /// Reads the clusters of one entry.
    pub fn read(&self, entry: &CacheEntry) -> Result<SceneClusters, TrainError> {
        let path = self.folder.join("clusters.bin");
        let mut bytes = vec![0; entry.num_bytes() as usize];
        File::open(&path)
            .and_then(|mut file| {
                file.seek(SeekFrom::Start(entry.offset_bytes))?;
                file.read_exact(&mut bytes)
            })
            .map_err(TrainError::io("reading the cluster cache", &path))?;
        let mut values: Vec<u32> =
            bytes.as_chunks::<2>().0.iter().map(|bytes| u32::from(u16::from_le_bytes(*bytes))).collect();
        let centroids = values.split_off(entry.num_tokens);
        Ok(SceneClusters::new(values, centroids)?)
    }
}
