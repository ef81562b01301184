//! Entries of a cluster cache and their index.

use clift_data::Ledger;
use serde::{Deserialize, Serialize};

use crate::config::MAX_TOKENS;

pub(crate) const VERSION: u32 = 1;

/// One clustered context set of a scene.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Entry {
    /// Key of the scene.
    pub key: String,
    /// Frames of the contexts.
    pub context: Vec<usize>,
    /// Tokens of the scene.
    pub num_tokens: usize,
    /// Clusters.
    pub num_storage_tokens: usize,
    /// Where the entry starts in `clusters.bin`.
    pub offset_bytes: u64,
}

/// What `index.json` holds.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Index {
    pub version: u32,
    /// Hash of the encoder's weights.
    pub encoder: String,
    /// The settings that decide the clusters, as JSON in a string: read back, numbers could differ in the last digit.
    pub settings: String,
    pub skipped: Ledger,
    pub entries: Vec<Entry>,
}

impl Entry {
    /// Whether a scene can have so many tokens and clusters. No number is allocated or added up before.
    pub(crate) fn is_possible(&self) -> bool {
        (1..=MAX_TOKENS).contains(&self.num_tokens) && (1..=self.num_tokens).contains(&self.num_storage_tokens)
    }

    pub(crate) fn num_bytes(&self) -> u64 {
        (self.num_tokens as u64).saturating_add(self.num_storage_tokens as u64).saturating_mul(2)
    }
}
