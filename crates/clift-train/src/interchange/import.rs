//! Imports a published checkpoint as a model directory: weights, config and a record of the import.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use clift_data::{ElementType, StateDict, hash_file};
use clift_model::{CliftVariant, InferredConfig, ModelConfig, PublishedTensor, published_tensors};
use serde::Serialize;

use crate::config::config::Config;
use crate::error::{TrainError, bad};
use crate::interchange::keys::Keys;
use crate::interchange::model_dir::{self, HostTensor};
use crate::interchange::problems;

const VERSION: u32 = 1;

/// Record of an import: `import.json` of the model directory.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
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

/// Reads a checkpoint of a `variant` and writes a model directory, completely or not at all. `num_heads` is the number of heads
/// where shapes do not determine it.
///
/// # Errors
/// [`TrainError::BadFile`] with all keys whose names, shapes or types do not fit the network, [`TrainError::BadConfig`] for an
/// impossible number of heads, [`TrainError::Abandoned`] if `stop` is set before all is read, and those of reading
/// and writing.
pub fn import(
    file: &Path,
    out: &Path,
    (variant, num_heads): (CliftVariant, Option<usize>),
    stop: &AtomicBool,
) -> Result<(Config, ImportRecord), TrainError> {
    model_dir::require_absent(out)?;
    let state = StateDict::open(file)?;
    let keys = Keys::of(&state)?;
    let sizes = keys.sizes(&state, variant, num_heads);
    check_sizes(&sizes, &state)?;
    let InferredConfig { config: model, has_condenser, .. } = sizes;
    let expected = published_tensors(&model, has_condenser);
    let problems = problems::problems(&keys, &state, &expected);
    if !problems.is_empty() {
        let text = problems::describe(&keys, &state, &problems, &model, num_heads);
        return Err(TrainError::bad_file("checkpoint", file)(text));
    }

    let num_bytes: u64 = expected.iter().map(|tensor| 4 * tensor.shape.iter().product::<usize>() as u64).sum();
    // Parameters of a network share no storage, though keys of a file may.
    if num_bytes > state.num_bytes.saturating_mul(2) {
        let reason =
            format!("the parameters take {num_bytes} bytes, more than twice the {} bytes of the file", state.num_bytes);
        return Err(TrainError::bad_file("checkpoint", file)(reason));
    }
    let (mut parameters, mut mapping, mut num_converted) = (vec![], vec![], 0);
    for tensor in &expected {
        if stop.load(Ordering::SeqCst) {
            return Err(TrainError::Abandoned { task: "importing".into() });
        }
        let key = &keys.network[&tensor.key];
        let values = state.read(key)?;
        num_converted += usize::from(state.tensor(key).is_some_and(|(found, _)| found != ElementType::F32));
        parameters.extend(parts(tensor, &values));
        mapping.push((key.clone(), tensor.parts.iter().map(|(path, _)| path.clone()).collect()));
    }
    let imported = ImportRecord {
        version: VERSION,
        file: file.file_name().unwrap_or_default().to_string_lossy().into_owned(),
        sha256: hash_file(file)?,
        variant,
        has_condenser,
        num_converted,
        parameters: mapping,
        ignored: keys.ignored,
        outside: keys.outside,
        passed_over: state.skipped_objects.clone(),
    };
    let config = model_dir::evaluation_config(model, out);
    model_dir::write_model_dir(out, &config, &parameters, &imported)?;
    Ok((config, imported))
}

/// Checks the number of heads, which shapes do not determine, and the other sizes.
fn check_sizes(sizes: &InferredConfig, state: &StateDict) -> Result<(), TrainError> {
    let InferredConfig { config: ModelConfig { dim, num_heads, .. }, has_num_heads, .. } = sizes;
    if !has_num_heads || *num_heads == 0 || !dim.is_multiple_of(*num_heads) {
        let (value, why) = if *has_num_heads {
            (num_heads.to_string(), "")
        } else {
            ("not given".into(), "tensor shapes do not determine the number: ")
        };
        let file = state.path.display();
        return Err(bad("--num-heads", value, &format!("{why}give a divisor of the width {dim}: {file}")));
    }
    sizes.config.validate().map_err(TrainError::bad_file("checkpoint", &state.path))
}

fn parts<'a>(tensor: &'a PublishedTensor, values: &'a [f32]) -> impl Iterator<Item = HostTensor> + 'a {
    let row_len: usize = tensor.shape[1..].iter().product();
    tensor.parts.iter().map(move |(path, rows)| {
        let mut shape = tensor.shape.clone();
        shape[0] = rows.len();
        (path.clone(), shape, values[rows.start * row_len..rows.end * row_len].to_vec())
    })
}

#[cfg(test)]
mod tests;
