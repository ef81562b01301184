//! The keys of a checkpoint: those of the network, under the names of `interchange`, and the others.

use std::collections::BTreeMap;

use clift_data::StateDict;
use clift_model::{CliftVariant, InferredConfig, PERCEPTUAL_PREFIX, PREFIX, canonical_key, infer_config};

use crate::error::TrainError;
use crate::interchange::record::ImportOptions;

/// Letters of a key that a message shows.
pub(crate) const MAX_SHOWN: usize = 160;
/// Kinds of keys outside the network that are told apart.
const MAX_OUTSIDE: usize = 200;

/// The keys of a checkpoint.
pub(crate) struct Keys {
    /// Those of the network: as `interchange` writes them, and as the file does.
    pub network: BTreeMap<String, String>,
    /// What stands before them in the file.
    pub prefix: &'static str,
    /// Keys that start as the network's do, but for the prefix that the others have: as above.
    pub strays: BTreeMap<String, String>,
    /// First parts of those that are known to be no part of the network, and how many of them there are.
    pub ignored: BTreeMap<String, usize>,
    /// Patterns of those that have names of nothing that is known.
    pub outside: BTreeMap<String, usize>,
}

impl Keys {
    pub fn of(state: &StateDict, options: &ImportOptions) -> Result<Self, TrainError> {
        let mut is_used = vec![false; options.renames.len()];
        let mut all = Vec::new();
        for key in state.keys() {
            let mut name = key.to_owned();
            for ((from, to), is_used) in options.renames.iter().zip(&mut is_used) {
                if name.contains(from) {
                    *is_used = true;
                    name = name.replace(from, to);
                }
            }
            all.push((canonical_key(&name), key));
        }
        if let Some(((from, to), _)) = options.renames.iter().zip(&is_used).find(|(_, is_used)| !**is_used) {
            let first = all.first().map_or("none", |(_, key)| key);
            let fix = format!("no key has {from:?} in it; the first is {}: {}", shown(first), state.path().display());
            return Err(TrainError::BadConfig { key: "--rename".into(), value: format!("{from}={to}"), fix });
        }

        // A state dict saved on its own has no prefix.
        let prefix = if all.iter().any(|(name, _)| name.starts_with(PREFIX)) { PREFIX } else { "" };
        let mut keys = Self {
            network: BTreeMap::new(),
            prefix,
            strays: BTreeMap::new(),
            ignored: BTreeMap::new(),
            outside: BTreeMap::new(),
        };
        for (name, key) in all {
            if name.starts_with(PERCEPTUAL_PREFIX) {
                *keys.ignored.entry(PERCEPTUAL_PREFIX.trim_end_matches('.').into()).or_insert(0) += 1;
            } else if let Some(plain) = name.strip_prefix(prefix) {
                if let Some(other) = keys.network.insert(plain.to_owned(), key.to_owned()) {
                    let reason = format!("{} and {} are both {}", shown(&other), shown(key), shown(plain));
                    return Err(TrainError::bad_file("checkpoint", state.path())(reason));
                }
            } else if starts_as_network(&name) {
                keys.strays.insert(name, key.to_owned());
            } else {
                let pattern = shown(&pattern(key));
                let is_known = keys.outside.contains_key(&pattern) || keys.outside.len() < MAX_OUTSIDE;
                *keys.outside.entry(if is_known { pattern } else { "others".into() }).or_insert(0) += 1;
            }
        }
        Ok(keys)
    }

    /// The sizes that the shapes of the network's keys show.
    pub fn sizes(&self, state: &StateDict, variant: CliftVariant, num_heads: Option<usize>) -> InferredConfig {
        let shape = |key: &str| state.tensor(key).map_or(&[][..], |(_, shape)| shape);
        infer_config(variant, num_heads, self.network.iter().map(|(name, key)| (name.as_str(), shape(key))))
    }
}

/// Whether a key without the network's prefix is probably the network's all the same.
fn starts_as_network(name: &str) -> bool {
    let first = name.split('.').next().unwrap_or_default();
    matches!(first, "encoder" | "decoder" | "squeezer" | "patch_to_image")
        || first.starts_with("linear_")
        || first.ends_with("_norm")
}

/// Whether a part of a key is the number of a layer.
pub(crate) fn is_number(part: &str) -> bool {
    !part.is_empty() && part.bytes().all(|byte| byte.is_ascii_digit())
}

/// A key with `N` for every number in it.
pub(crate) fn pattern(key: &str) -> String {
    key.split('.').map(|part| if is_number(part) { "N" } else { part }).collect::<Vec<_>>().join(".")
}

/// A key of a file that may be hostile, for a terminal.
pub(crate) fn shown(key: &str) -> String {
    let short: String = key.chars().take(MAX_SHOWN).collect();
    let rest = if short.len() < key.len() { ".." } else { "" };
    format!("{}{rest}", short.escape_debug())
}
