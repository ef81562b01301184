//! Keys of a checkpoint: those of the network, under canonical names, and others.

use std::collections::BTreeMap;

use clift_data::StateDict;
use clift_model::{CliftVariant, InferredConfig, PERCEPTUAL_PREFIX, PREFIX, canonical_key, infer_config};

use crate::error::TrainError;

/// Most characters of a key in a message.
const MAX_SHOWN: usize = 160;
/// Most patterns of keys outside the network.
const MAX_OUTSIDE: usize = 200;

#[derive(Default)]
pub(crate) struct Keys {
    /// Keys of the network: canonical name to name in the file.
    pub network: BTreeMap<String, String>,
    pub prefix: &'static str,
    /// First parts of keys that are known not to belong to the network, with their numbers.
    pub ignored: BTreeMap<String, usize>,
    /// Patterns of unknown keys outside the network, with their numbers.
    pub outside: BTreeMap<String, usize>,
}

impl Keys {
    pub fn of(state: &StateDict) -> Result<Self, TrainError> {
        let all: Vec<(String, &str)> = state.keys().map(|key| (canonical_key(key), key)).collect();
        // A state dict of the network alone has no prefix.
        let prefix = if all.iter().any(|(name, _)| name.starts_with(PREFIX)) { PREFIX } else { "" };
        let mut keys = Self { prefix, ..Self::default() };
        for (name, key) in all {
            if name.starts_with(PERCEPTUAL_PREFIX) {
                *keys.ignored.entry(PERCEPTUAL_PREFIX.trim_end_matches('.').into()).or_insert(0) += 1;
            } else if let Some(plain) = name.strip_prefix(prefix) {
                if let Some(other) = keys.network.insert(plain.to_owned(), key.to_owned()) {
                    let reason = format!("{} and {} are both {}", printable(&other), printable(key), printable(plain));
                    return Err(TrainError::bad_file("checkpoint", &state.path)(reason));
                }
            } else {
                let pattern = printable(&pattern(key));
                let is_known = keys.outside.contains_key(&pattern) || keys.outside.len() < MAX_OUTSIDE;
                *keys.outside.entry(if is_known { pattern } else { "others".into() }).or_insert(0) += 1;
            }
        }
        Ok(keys)
    }

    pub fn sizes(&self, state: &StateDict, variant: CliftVariant, num_heads: Option<usize>) -> InferredConfig {
        let shape = |key: &str| state.tensor(key).map_or(&[][..], |(_, shape)| shape);
        infer_config(variant, num_heads, self.network.iter().map(|(name, key)| (name.as_str(), shape(key))))
    }
}

fn is_number(part: &str) -> bool {
    !part.is_empty() && part.bytes().all(|byte| byte.is_ascii_digit())
}

/// Replaces every number in a key by `N`.
pub(crate) fn pattern(key: &str) -> String {
    key.split('.').map(|part| if is_number(part) { "N" } else { part }).collect::<Vec<_>>().join(".")
}

/// Shortens and escapes a key of an untrusted file for a terminal.
pub(crate) fn printable(key: &str) -> String {
    let short: String = key.chars().take(MAX_SHOWN).collect();
    let rest = if short.len() < key.len() { ".." } else { "" };
    format!("{}{rest}", short.escape_debug())
}
