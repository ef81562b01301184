//! The finished cluster cache of a run.
//!
//! A folder with `index.json` (entries, encoder, settings) and `clusters.bin` (per entry the cluster of every token and the
//! token of every cluster, little-endian u16).

use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use clift_core::{PoseRotation, PoseScale};
use clift_data::{Crop, FileOptions, SceneFilters, SkipReport, SourceKind, SyntheticConfig, ViewSampler};
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
    /// Number of clusters.
    pub num_storage_tokens: usize,
    /// Offset of the entry in `clusters.bin`.
    pub offset_bytes: u64,
}

/// Content of `index.json`.
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
    crop: Crop,
    filters: SceneFilters,
    views: ViewSampler,
    clusters: ClustersConfig,
}

impl CacheSettings {
    /// Returns the settings of a config.
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
            crop: data.crop,
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
        let wanted = CacheSettings::new(config);
        if index.settings != wanted {
            let key = first_difference(&[&index.settings, &wanted].map(|settings| serde_json::json!(settings)));
            return Err(stale(format!("{} differs from that of this run", key.unwrap_or_default())));
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

    /// Returns the scenes that could not be clustered.
    pub fn skipped(&self) -> &SkipReport {
        &self.index.skipped
    }

    /// Reads the clusters of one entry.
    ///
    /// # Errors
    /// [`TrainError::Io`], and [`clift_model::ModelError::BadClusters`] for inconsistent indices.
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

/// Returns the first key, by path, with two values.
fn first_difference(values: &[Value; 2]) -> Option<String> {
    let [Some(one), Some(other)] = values.each_ref().map(Value::as_object) else { return None };
    let key = one.keys().chain(other.keys()).find(|key| one.get(*key) != other.get(*key))?;
    let below = [one, other].map(|object| object.get(key).cloned().unwrap_or_default());
    Some(first_difference(&below).map_or_else(|| key.clone(), |path| format!("{key}.{path}")))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Opens a cache whose only entry has these counts, and returns the error message or "opened".
    fn opened(num_tokens: usize, num_storage_tokens: usize) -> String {
        let config = Config::default();
        let folder = tempfile::tempdir().expect("a temporary folder");
        let entry = CacheEntry { key: "a".into(), context: vec![0], num_tokens, num_storage_tokens, offset_bytes: 0 };
        let index = CacheIndex {
            version: VERSION,
            encoder: "e".into(),
            settings: CacheSettings::new(&config),
            skipped: SkipReport::new(1),
            entries: vec![entry],
        };
        std::fs::write(folder.path().join("index.json"), serde_json::to_vec(&index).expect("JSON")).expect("writable");
        std::fs::write(folder.path().join("clusters.bin"), [0, 0, 0, 0]).expect("writable");
        ClusterCache::open(folder.path(), &config, "e").map_or_else(|error| error.to_string(), |_| "opened".into())
    }

    #[test]
    fn impossible_counts_are_refused_before_allocation() {
        assert_eq!(opened(1, 1), "opened");
        for (num_tokens, num_storage_tokens) in [(usize::MAX, 3), (1 << 62, 1 << 62), (0, 0), (1, 2), (2, 0)] {
            let message = opened(num_tokens, num_storage_tokens);
            let expected = format!("scene a has {num_storage_tokens} clusters of {num_tokens} tokens");
            assert!(message.contains(&expected), "{message}");
        }
    }

    #[test]
    fn the_first_other_setting_is_named() {
        let mut config = Config::default();
        let before = CacheSettings::new(&config);
        config.clusters.kmeans.max_iterations += 1;
        let values = [before, CacheSettings::new(&config)].map(|settings| serde_json::json!(settings));
        assert_eq!(first_difference(&values).as_deref(), Some("clusters.kmeans.max_iterations"));
        assert_eq!(first_difference(&[values[0].clone(), values[0].clone()]), None);
    }
}
