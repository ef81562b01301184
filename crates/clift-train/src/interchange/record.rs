//! Options and record of an import.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use clift_model::{CliftVariant, PROJECTIONS};
use serde::{Deserialize, Serialize};

use crate::error::TrainError;

/// What the user gives beside a checkpoint.
#[derive(Clone, Debug)]
pub struct ImportOptions {
    /// Which network it holds.
    pub variant: CliftVariant,
    /// Its heads, where neither a shape nor the file says them.
    pub num_heads: Option<usize>,
    /// Whether parameters that are not in f32 are converted to it; they are an error otherwise.
    pub convert: bool,
    /// Texts that are replaced in keys as the file has them, in this order: `(from, to)`.
    pub renames: Vec<(String, String)>,
}

/// What an import did; `import.json` of the model directory.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ImportRecord {
    /// Version of this file.
    pub version: u32,
    /// Name of the checkpoint.
    pub file: String,
    /// SHA-256 of its bytes.
    pub sha256: String,
    /// The network.
    pub variant: CliftVariant,
    /// Whether it has a condenser, as a second-stage checkpoint has.
    pub has_condenser: bool,
    /// Projections that are 1x1 convolutions there; `clift export` writes them so.
    pub convolutions: Vec<String>,
    /// Parameters that were not in f32.
    pub num_converted: usize,
    /// Keys of the checkpoint, each with the parameters it became.
    pub parameters: Vec<(String, Vec<String>)>,
    /// First parts of keys that are known to be no part of the network, each with how many keys there are.
    pub ignored: BTreeMap<String, usize>,
    /// Keys that are neither that nor the network's, with `N` for numbers, each with how many there are.
    #[serde(default)]
    pub outside: BTreeMap<String, usize>,
    /// Python classes and functions that were passed over, with the objects made of them.
    pub passed_over: BTreeSet<String>,
}

/// Stops where the user has asked for it.
pub(crate) fn check_stop(stop: &AtomicBool) -> Result<(), TrainError> {
    if stop.load(Ordering::SeqCst) { Err(TrainError::Abandoned { work: "the import".into() }) } else { Ok(()) }
}

impl ImportRecord {
    /// Reads the record of a model directory; `None` for a model that was trained here.
    ///
    /// # Errors
    /// [`TrainError::BadFile`] for a damaged file.
    pub fn read(folder: &Path) -> Result<Option<Self>, TrainError> {
        let path = folder.join("import.json");
        if !path.exists() {
            return Ok(None);
        }
        let text = std::fs::read(&path).map_err(TrainError::io("reading what was imported", &path))?;
        let imported: Self = serde_json::from_slice(&text).map_err(TrainError::bad_file("import.json", &path))?;
        if let Some(layer) = imported.convolutions.iter().find(|layer| !PROJECTIONS.contains(&layer.as_str())) {
            let reason = format!("{layer:?} is no projection");
            return Err(TrainError::bad_file("import.json", &path)(reason));
        }
        Ok(Some(imported))
    }
}
