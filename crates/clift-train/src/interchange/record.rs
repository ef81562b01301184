//! Options and record of an import.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use clift_model::{CliftVariant, PROJECTIONS};
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::error::TrainError;
use crate::version::check_version;

pub(crate) const VERSION: u32 = 1;

/// Options of an import.
#[derive(Clone, Debug)]
pub struct ImportOptions {
    /// Architecture of the network.
    pub variant: CliftVariant,
    /// Number of heads, if neither the shapes nor the file determine it.
    pub num_heads: Option<usize>,
    /// Whether parameters of other types are converted to f32; otherwise they are an error.
    pub convert: bool,
    /// Replacements in the keys of the file, in this order: `(from, to)`.
    pub renames: Vec<(String, String)>,
}

/// Record of an import: `import.json` of the model directory.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ImportRecord {
    /// Version of this file.
    pub version: u32,
    /// File name of the checkpoint.
    pub file: String,
    /// SHA-256 of the file.
    pub sha256: String,
    /// Architecture of the network.
    pub variant: CliftVariant,
    /// Whether the network has a condenser, as in checkpoints of the second stage.
    pub has_condenser: bool,
    /// Projections stored as 1x1 convolutions; `clift export` writes them likewise.
    pub convolutions: Vec<String>,
    /// Number of parameters converted to f32.
    pub num_converted: usize,
    /// Keys of the checkpoint with the parameters made of them.
    pub parameters: Vec<(String, Vec<String>)>,
    /// First parts of keys that are known not to belong to the network, with their numbers.
    pub ignored: BTreeMap<String, usize>,
    /// Patterns of unknown keys outside the network, with their numbers.
    pub outside: BTreeMap<String, usize>,
    /// Python classes and functions whose objects were skipped.
    pub passed_over: BTreeSet<String>,
}

pub(crate) fn check_stop(stop: &AtomicBool) -> Result<(), TrainError> {
    if stop.load(Ordering::SeqCst) { Err(TrainError::Abandoned { task: "importing".into() }) } else { Ok(()) }
}

impl ImportRecord {
    /// Reads the record of a model directory; `None` for a model that was not imported.
    ///
    /// # Errors
    /// [`TrainError::BadFile`] for a damaged file.
    pub fn read(folder: &Path) -> Result<Option<Self>, TrainError> {
        let path = folder.join("import.json");
        if !path.exists() {
            return Ok(None);
        }
        let text = std::fs::read(&path).map_err(TrainError::io("reading what was imported", &path))?;
        let imported: Value = serde_json::from_slice(&text).map_err(TrainError::bad_file("import.json", &path))?;
        check_version(&imported, VERSION).map_err(TrainError::bad_file("import.json", &path))?;
        let imported: Self = serde_json::from_value(imported).map_err(TrainError::bad_file("import.json", &path))?;
        if let Some(layer) = imported.convolutions.iter().find(|layer| !PROJECTIONS.contains(&layer.as_str())) {
            return Err(TrainError::bad_file("import.json", &path)(format!("unknown projection {layer:?}")));
        }
        Ok(Some(imported))
    }
}
