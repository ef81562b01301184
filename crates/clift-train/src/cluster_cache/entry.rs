//! Entries of a cluster cache and their index.

use clift_data::SkipReport;
use clift_model::Grouping;
use serde::{Deserialize, Serialize};

use crate::config::config::{Config, MAX_TOKENS};

pub(crate) const VERSION: u32 = 1;

/// One clustered context set of a scene.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CacheEntry {
    /// Key of the scene.
    pub key: String,
    /// Frames of the contexts.
    pub context: Vec<usize>,
    /// Number of tokens of the scene.
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
    /// Settings that determine the clusters, as JSON in a string, compared as text.
    pub settings: String,
    pub skipped: SkipReport,
    pub entries: Vec<CacheEntry>,
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

/// Returns the settings that determine the clusters, as JSON.
pub(crate) fn settings(config: &Config) -> String {
    let data = &config.data;
    let mut clusters = serde_json::json!(config.clusters);
    if config.clusters.grouping == Grouping::Tile {
        // The former name, which existing caches have.
        clusters["grouping"] = "patch".into();
    }
    serde_json::json!({
        "seed": config.seed,
        "source": data.source,
        "root": data.root,
        "files": data.files,
        "synthetic": data.synthetic,
        "size": [data.width, data.height],
        "poses": [serde_json::json!(data.pose_rotation), serde_json::json!(data.pose_scale)],
        "exact_principal_point": data.clip_options().exact_principal_point,
        "filters": data.filters,
        "views": data.views,
        "clusters": clusters,
    })
    .to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_of_tiles_keep_the_former_name() {
        let mut config = Config::default();
        assert!(settings(&config).contains("\"grouping\":\"kmeans\""));
        config.clusters.grouping = Grouping::Tile;
        assert!(settings(&config).contains("\"grouping\":\"patch\""));
    }
}
