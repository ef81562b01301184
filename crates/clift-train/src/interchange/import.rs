//! Imports a published checkpoint as a model directory: weights, config and a record of the import.

use std::path::Path;
use std::sync::atomic::AtomicBool;

use clift_data::{ElementType, StateDict, hash_file};
use clift_model::{InferredConfig, PublishedTensor, published_tensors};

use crate::config::config::Config;
use crate::error::{TrainError, bad};
use crate::interchange::keys::{Keys, printable};
use crate::interchange::model_dir::{self, HostTensor};
use crate::interchange::problems;
use crate::interchange::record::{ImportOptions, ImportRecord, VERSION, check_stop};

/// Reads a checkpoint and writes a model directory, completely or not at all.
///
/// # Errors
/// [`TrainError::BadFile`] with all keys whose names, shapes or types do not fit the network, [`TrainError::BadConfig`] for an
/// impossible number of heads and renames without effect, [`TrainError::Abandoned`] if `stop` is set, and those of reading
/// and writing.
pub fn import(
    file: &Path,
    out: &Path,
    options: &ImportOptions,
    stop: &AtomicBool,
) -> Result<(Config, ImportRecord), TrainError> {
    model_dir::require_absent(out)?;
    let state = StateDict::open(file)?;
    let keys = Keys::of(&state, options)?;
    let options = &ImportOptions { num_heads: num_heads(&state, options)?, ..options.clone() };
    let sizes = keys.sizes(&state, options.variant, options.num_heads);
    check_sizes(&sizes, &keys, &state)?;
    let InferredConfig { config: model, has_condenser, .. } = sizes;
    let expected = published_tensors(&model, has_condenser);
    let problems = problems::problems(&keys, &state, &expected, options);
    if !problems.is_empty() {
        let text = problems::describe(&keys, &state, &problems, &model, options);
        return Err(TrainError::bad_file("checkpoint", file)(text));
    }

    let num_bytes: u64 = expected.iter().map(|tensor| 4 * tensor.shape.iter().product::<usize>() as u64).sum();
    // Parameters of a network share no storage, though keys of a file may.
    if num_bytes > state.num_bytes.saturating_mul(2) {
        let reason =
            format!("the parameters take {num_bytes} bytes, more than twice the {} bytes of the file", state.num_bytes);
        return Err(TrainError::bad_file("checkpoint", file)(reason));
    }
    let (mut parameters, mut mapping, mut convolutions, mut num_converted) = (vec![], vec![], vec![], 0);
    for tensor in &expected {
        check_stop(stop)?;
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
    let imported = ImportRecord {
        version: VERSION,
        file: file.file_name().unwrap_or_default().to_string_lossy().into_owned(),
        sha256: hash_file(file)?,
        variant: options.variant,
        has_condenser,
        convolutions,
        num_converted,
        parameters: mapping,
        ignored: keys.ignored,
        outside: keys.outside,
        passed_over: state.skipped_objects.clone(),
    };
    let config = model_dir::evaluation_config(model, out);
    model_dir::write_model_dir(out, &config, &parameters, (&imported, file), stop)?;
    Ok((config, imported))
}

/// Returns the given number of heads, or that stored by `clift export`.
fn num_heads(state: &StateDict, options: &ImportOptions) -> Result<Option<usize>, TrainError> {
    let stored = state.size("num_heads").and_then(|size| usize::try_from(size).ok());
    match (options.num_heads, stored) {
        (Some(given), Some(stored)) if given != stored => {
            let fix = format!("the checkpoint has {stored} heads: omit the option: {}", state.path.display());
            Err(bad("--num-heads", given, &fix))
        }
        (given, stored) => Ok(given.or(stored)),
    }
}

/// Checks the number of heads, which shapes do not determine, and the other sizes.
fn check_sizes(sizes: &InferredConfig, keys: &Keys, state: &StateDict) -> Result<(), TrainError> {
    let InferredConfig { config: model, has_num_heads, width_key, .. } = sizes;
    let file = &state.path;
    let num_heads = model.num_heads;
    if !has_num_heads || num_heads == 0 || !model.dim.is_multiple_of(num_heads) {
        let key = width_key.as_ref().map(|key| &keys.network[key]);
        let from =
            key.and_then(|key| state.tensor(key).map(|(_, shape)| format!(" ({} is {shape:?})", printable(key))));
        let (dim, from, file) = (model.dim, from.unwrap_or_default(), file.display());
        let (value, why) = if *has_num_heads {
            (num_heads.to_string(), "")
        } else {
            ("not given".into(), "tensor shapes do not determine the number: ")
        };
        let fix = format!("{why}give the number of heads, a divisor of the width {dim}{from}: {file}");
        return Err(bad("--num-heads", value, &fix));
    }
    model.validate().map_err(TrainError::bad_file("checkpoint", file))
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
