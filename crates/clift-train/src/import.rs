//! A published checkpoint to a model directory: weights, config, and what came from where.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use clift_data::ElementType;
use clift_data::StateDict;
use clift_model::Variant;
use clift_model::interchange::{self, CheckpointTensor, PROJECTIONS, Sizes};
use serde::{Deserialize, Serialize};

use crate::TrainError;
use crate::config::Config;
use crate::model_dir::{self, Parameter};

mod keys;
mod problems;

use keys::Keys;

/// Letters of a key that a message shows.
const MAX_SHOWN: usize = 160;

/// What the user says about a checkpoint.
#[derive(Clone, Debug)]
pub struct ImportOptions {
    /// Which network it holds.
    pub variant: Variant,
    /// Its heads, where neither a shape nor the file says them.
    pub num_heads: Option<usize>,
    /// Whether parameters that are not in f32 are converted to it; they are an error otherwise.
    pub convert: bool,
    /// Texts that are replaced in keys as the file has them, in this order: `(from, to)`.
    pub renames: Vec<(String, String)>,
}

/// What an import did; `import.json` of the model directory.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Imported {
    /// Version of this file.
    pub version: u32,
    /// Name of the checkpoint.
    pub file: String,
    /// SHA-256 of its bytes.
    pub sha256: String,
    /// The network.
    pub variant: Variant,
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

/// Reads a checkpoint and writes a model directory: all of it or nothing.
///
/// # Errors
/// [`TrainError::BadFile`] where keys, shapes or number formats are not the network's, with all of them;
/// [`TrainError::BadConfig`] for heads that cannot be and renames of nothing; [`TrainError::Abandoned`] once `stop`
/// is set; whatever reading the file or writing the directory gives.
pub fn import(
    file: &Path,
    out: &Path,
    options: &ImportOptions,
    stop: &AtomicBool,
) -> Result<(Config, Imported), TrainError> {
    model_dir::refuse_existing(out)?;
    let state = StateDict::open(file)?;
    let keys = Keys::of(&state, options)?;
    let options = &ImportOptions { num_heads: num_heads(&state, options)?, ..options.clone() };
    let sizes = keys.sizes(&state, options.variant, options.num_heads);
    check_sizes(&sizes, &keys, &state)?;
    let Sizes { config: model, has_condenser, .. } = sizes;
    let expected = interchange::tensors(&model, has_condenser);
    let problems = problems::problems(&keys, &state, &expected, options);
    if !problems.is_empty() {
        let told = problems::told(&keys, &state, &problems, &model, options);
        return Err(TrainError::bad_file("checkpoint", file)(told));
    }

    let num_bytes: u64 = expected.iter().map(|tensor| 4 * tensor.shape.iter().product::<usize>() as u64).sum();
    // Keys may share a storage, which a network's parameters do not.
    if num_bytes > state.num_bytes().saturating_mul(2) {
        let reason = format!("its parameters take {num_bytes} bytes, more than twice the {} it has", state.num_bytes());
        return Err(TrainError::bad_file("checkpoint", file)(reason));
    }
    let (mut parameters, mut mapping, mut convolutions, mut num_converted) = (vec![], vec![], vec![], 0);
    for tensor in &expected {
        go_on(stop)?;
        let key = &keys.network[&tensor.key];
        let values = state.read(key)?;
        let (element_type, shape) = state.tensor(key).unwrap_or((ElementType::F32, &[]));
        num_converted += usize::from(element_type != ElementType::F32);
        if shape.len() == 4 {
            convolutions.push(tensor.key.trim_end_matches(".weight").to_owned());
        }
        parameters.extend(parts(tensor, &values));
        mapping.push((key.clone(), tensor.parts.iter().map(|(path, _)| path.clone()).collect()));
    }
    let imported = Imported {
        version: 1,
        file: file.file_name().unwrap_or_default().to_string_lossy().into_owned(),
        sha256: model_dir::sha256(file)?,
        variant: options.variant,
        has_condenser,
        convolutions,
        num_converted,
        parameters: mapping,
        ignored: keys.ignored,
        outside: keys.outside,
        passed_over: state.passed_over().clone(),
    };
    let config = model_dir::evaluation_config(model, out);
    model_dir::write(out, &config, &parameters, &imported, stop)?;
    Ok((config, imported))
}

/// Stops where the user has asked for it.
pub(crate) fn go_on(stop: &AtomicBool) -> Result<(), TrainError> {
    if stop.load(Ordering::SeqCst) { Err(TrainError::Abandoned { work: "the import".into() }) } else { Ok(()) }
}

/// The heads that are given, or those that an export of this program says it has.
fn num_heads(state: &StateDict, options: &ImportOptions) -> Result<Option<usize>, TrainError> {
    let said = state.size("num_heads").and_then(|size| usize::try_from(size).ok());
    match (options.num_heads, said) {
        (Some(given), Some(said)) if given != said => {
            let fix = format!("the checkpoint says it has {said}: leave the option out: {}", state.path().display());
            Err(TrainError::BadConfig { key: "--num-heads".into(), value: given.to_string(), fix })
        }
        (given, said) => Ok(given.or(said)),
    }
}

/// What no shape shows must be right before anything else can be said.
fn check_sizes(sizes: &Sizes, keys: &Keys, state: &StateDict) -> Result<(), TrainError> {
    let Sizes { config: model, knows_heads, width_key, .. } = sizes;
    let file = state.path();
    let num_heads = model.num_heads;
    if !knows_heads || num_heads == 0 || !model.dim.is_multiple_of(num_heads) {
        let key = width_key.as_ref().map(|key| &keys.network[key]);
        let from = key.and_then(|key| state.tensor(key).map(|(_, shape)| format!(" ({} is {shape:?})", shown(key))));
        let (dim, from, file) = (model.dim, from.unwrap_or_default(), file.display());
        let (value, why) = if *knows_heads {
            (num_heads.to_string(), "")
        } else {
            ("not given".into(), "no shape shows them, and width 768 alone is published, with 8: ")
        };
        let fix = format!("{why}give the heads of this network, a divisor of its width {dim}{from}: {file}");
        return Err(TrainError::BadConfig { key: "--num-heads".into(), value, fix });
    }
    let bad_sizes = |error: clift_model::ModelError| TrainError::bad_file("checkpoint", file)(error);
    model.validate().map_err(bad_sizes)
}

/// The rows of a tensor that are parameters here.
fn parts<'a>(tensor: &'a CheckpointTensor, values: &'a [f32]) -> impl Iterator<Item = Parameter> + 'a {
    let row_len: usize = tensor.shape[1..].iter().product();
    tensor.parts.iter().map(move |(path, rows)| {
        let mut shape = tensor.shape.clone();
        shape[0] = rows.len();
        let values = values[rows.start * row_len..rows.end * row_len].to_vec();
        Parameter { path: path.clone(), shape, values }
    })
}

/// Whether a part of a key is the number of a layer.
fn is_number(part: &str) -> bool {
    !part.is_empty() && part.bytes().all(|byte| byte.is_ascii_digit())
}

/// A key with `N` for every number in it.
fn pattern(key: &str) -> String {
    key.split('.').map(|part| if is_number(part) { "N" } else { part }).collect::<Vec<_>>().join(".")
}

/// A key of a file that may be hostile, for a terminal.
fn shown(key: &str) -> String {
    let short: String = key.chars().take(MAX_SHOWN).collect();
    let rest = if short.len() < key.len() { ".." } else { "" };
    format!("{}{rest}", short.escape_debug())
}

impl Imported {
    /// Reads the record of a model directory; `None` for a model that was trained here.
    ///
    /// # Errors
    /// [`TrainError::BadFile`] for a damaged file.
    pub fn read(folder: &Path) -> Result<Option<Self>, TrainError> {
        let path: PathBuf = folder.join("import.json");
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

#[cfg(test)]
mod tests;
