//! Weights of PyTorch checkpoints: a state dict, on its own or inside the checkpoint of a training program.
//!
//! The pickle is parsed, never executed. Entries beside the state dict (optimiser states, hyper-parameters, callbacks of
//! any class) are skipped. Allocations are bounded by the size of the file.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use clift_core::replace_file;
use half::{bf16, f16};

use crate::error::DataError;
use crate::torch::archive::{Archive, tensor_span};
use crate::torch::file_kind::require_file;
use crate::torch::pickle::Pickle;
use crate::torch::pickle_writer::PickleWriter;
use crate::torch::values::{ElementType, Tensor, Value};

const FLOATS: [ElementType; 4] = [ElementType::F32, ElementType::F16, ElementType::BF16, ElementType::F64];
/// Longest key of a tensor; each is copied.
const MAX_KEY_BYTES: usize = 4096;

/// An open checkpoint. Tensors are read on demand.
pub struct StateDict {
    /// Path of the file.
    pub path: PathBuf,
    /// Size of the file in bytes.
    pub num_bytes: u64,
    /// Python names of skipped objects of the file, at most 256.
    pub skipped_objects: BTreeSet<String>,
    archive: Archive,
    tensors: BTreeMap<String, Option<Tensor>>,
}

impl StateDict {
    /// Opens a file whose outermost object is a state dict, or a dict with an entry `state_dict`.
    ///
    /// # Errors
    /// [`DataError::BadCheckpoint`] for a truncated file, another format or a missing state dict,
    /// [`DataError::BadPickle`] for a malformed pickle, and [`DataError::RefusedGlobal`] for an attack.
    pub fn open(path: &Path) -> Result<Self, DataError> {
        let bad = |what: String| DataError::BadCheckpoint { what, path: path.to_path_buf() };
        require_file(path)?;
        let num_bytes = std::fs::metadata(path).map_err(DataError::io("opening the checkpoint", path))?.len();
        let archive = Archive::open(path).map_err(as_checkpoint)?;
        let bytes = archive.read_pickle(path).map_err(as_checkpoint)?;
        let pickle = Pickle::parse(&bytes, path)?;
        let root = pickle.root();
        let state = pickle.item(root, "state_dict").unwrap_or(root);
        let Value::Dict(items) = state else {
            let object =
                if pickle.item(root, "state_dict").is_some() { "`state_dict`" } else { "the outermost object" };
            return Err(bad(format!("{object} is not a dict of tensors")));
        };
        let mut tensors = BTreeMap::new();
        for (key, value) in items {
            // Keys of state dicts are strings.
            if let Value::Str(key) = pickle.get(*key) {
                if key.len() > MAX_KEY_BYTES {
                    return Err(bad(format!("a key of {} bytes, expected at most {MAX_KEY_BYTES}", key.len())));
                }
                let tensor = match pickle.get(*value) {
                    Value::Tensor(tensor) => Some((**tensor).clone()),
                    _ => None,
                };
                tensors.insert(key.clone(), tensor);
            }
        }
        if tensors.values().all(Option::is_none) {
            return Err(bad("neither the outermost object nor an entry `state_dict` holds tensors".into()));
        }
        Ok(Self { path: path.into(), num_bytes, skipped_objects: pickle.skipped_objects, archive, tensors })
    }

    /// Returns the keys, sorted.
    pub fn keys(&self) -> impl Iterator<Item = &str> {
        self.tensors.keys().map(String::as_str)
    }

    /// Returns number format and shape of a tensor; `None` for a missing key or another value.
    pub fn tensor(&self, key: &str) -> Option<(ElementType, &[u64])> {
        let tensor = self.tensors.get(key)?.as_ref()?;
        Some((tensor.storage.element_type, &tensor.shape))
    }

    /// Reads a tensor of floats as f32, row-major.
    ///
    /// # Errors
    /// [`DataError::BadCheckpoint`] for a key without a tensor of floats, a tensor that is not contiguous or exceeds its
    /// storage, and a value that is not finite in f32.
    pub fn read(&self, key: &str) -> Result<Vec<f32>, DataError> {
        let Some(Some(tensor)) = self.tensors.get(key) else {
            let what = format!("{}: no tensor", key.escape_debug());
            return Err(DataError::BadCheckpoint { what, path: self.path.clone() });
        };
        let bad = |what: String| {
            let what = format!("{} {:?}: {what}", key.escape_debug(), tensor.shape);
            DataError::BadCheckpoint { what, path: self.path.clone() }
        };
        let shape: Vec<Option<u64>> = tensor.shape.iter().map(|size| Some(*size)).collect();
        let value = Value::Tensor(Box::new(tensor.clone()));
        let (span, element_type) = tensor_span(&value, &shape, &FLOATS, &self.archive).map_err(bad)?;
        let bytes = span.read(&self.path).map_err(|error| match error {
            DataError::BadChunk { what, .. } => bad(what),
            other => as_checkpoint(other),
        })?;
        let values = to_f32(&bytes, element_type);
        match values.iter().position(|value| !value.is_finite()) {
            Some(position) => Err(bad(format!("value {position} is {}", values[position]))),
            None => Ok(values),
        }
    }
}

fn to_f32(bytes: &[u8], element_type: ElementType) -> Vec<f32> {
    match element_type {
        ElementType::F16 => bytes.as_chunks().0.iter().map(|bytes| f16::from_le_bytes(*bytes).to_f32()).collect(),
        ElementType::BF16 => bytes.as_chunks().0.iter().map(|bytes| bf16::from_le_bytes(*bytes).to_f32()).collect(),
        ElementType::F64 => bytes.as_chunks().0.iter().map(|bytes| f64::from_le_bytes(*bytes) as f32).collect(),
        _ => bytes.as_chunks().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect(),
    }
}

/// Converts errors of the archive reader, which is written for chunks.
fn as_checkpoint(error: DataError) -> DataError {
    match error {
        DataError::BadChunk { what, path } => DataError::BadCheckpoint { what, path },
        DataError::Io { source, path, .. } => DataError::Io { action: "reading the checkpoint", source, path },
        other => other,
    }
}

/// Writes `{"state_dict": {key: tensor}}` in f32, for tests.
///
/// # Errors
/// [`DataError::Io`]; the former file is then unchanged.
pub fn write_state_dict(path: &Path, tensors: &[(String, Vec<usize>, Vec<f32>)]) -> Result<(), DataError> {
    let mut pickle = PickleWriter::new();
    pickle.raw(b"}(");
    pickle.string("state_dict");
    pickle.raw(b"}(");
    for (key, shape, values) in tensors {
        pickle.string(key);
        pickle.tensor("FloatStorage", values.iter().flat_map(|value| value.to_le_bytes()).collect(), shape);
    }
    pickle.raw(b"uu.");
    let prefix = path.file_stem().unwrap_or_default().to_string_lossy();
    let bytes = pickle.pack(&prefix).map_err(|error| DataError::io("packing a checkpoint", path)(error.into()))?;
    replace_file(path, &bytes).map_err(DataError::io("writing a checkpoint", path))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{self, read_from_file};

    fn fixture(name: &str) -> PathBuf {
        testing::fixture("checkpoints").join(name)
    }

    #[test]
    fn non_finite_values_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.ckpt");
        write_state_dict(&path, &[("x".into(), vec![2], vec![1.0, f32::NAN])]).unwrap();
        let message = StateDict::open(&path).unwrap().read("x").unwrap_err().to_string();
        assert!(message.starts_with("bad checkpoint: x [2]: value 1 is NaN: "), "{message}");
    }

    #[test]
    fn truncated_and_other_files_are_errors() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.ckpt");
        let whole = std::fs::read(fixture("re10k_first.ckpt")).unwrap();
        for length in (0..whole.len()).step_by(whole.len() / 40) {
            std::fs::write(&path, &whole[..length]).unwrap();
            let message = StateDict::open(&path).map(|_| ()).unwrap_err().to_string();
            assert!(message.starts_with("bad checkpoint: ") && message.ends_with("a.ckpt"), "{message}");
        }
        let chunk = fixture("../re10k-mini/test/000000.torch");
        let message = StateDict::open(&chunk).map(|_| ()).unwrap_err().to_string();
        assert!(message.contains("the outermost object is not a dict of tensors"), "{message}");
        let message = StateDict::open(&fixture("none.ckpt")).map(|_| ()).unwrap_err().to_string();
        assert!(message.starts_with("opening the checkpoint failed"), "{message}");
    }

    fn read(pickle: PickleWriter) -> Result<Vec<f32>, String> {
        let read = |path: &Path| StateDict::open(path).and_then(|state| state.read("x"));
        read_from_file("a.ckpt", pickle.pack("a").unwrap(), read).map_err(|error| error.to_string())
    }

    fn strided(shape: &[usize], stride: &[usize]) -> Result<Vec<f32>, String> {
        let mut pickle = PickleWriter::new();
        pickle.raw(b"}");
        pickle.string("x");
        let storage = (0..24_u8).flat_map(|value| f32::from(value).to_le_bytes()).collect();
        pickle.strided_tensor("FloatStorage", storage, shape, stride);
        pickle.raw(b"s.");
        read(pickle)
    }

    #[test]
    fn tensors_beyond_their_storage_and_in_another_order_are_refused() {
        let big = 1 << 40;
        for (shape, stride) in [(&[big, big][..], &[big, 1][..]), (&[1 << 31], &[1]), (&[25], &[1])] {
            let message = strided(shape, stride).unwrap_err();
            assert!(message.starts_with("bad checkpoint: x [") && message.contains("exceeds its storage"), "{message}");
        }
        assert_eq!(strided(&[2, big, 0], &[1, 0, 1]), Ok(vec![]), "no element, whatever the strides");
        for (shape, stride) in [([2, 3], [1, 2]), ([big, 2], [0, 1]), ([4, 4], [1, 1])] {
            assert!(strided(&shape, &stride).unwrap_err().contains("tensor.contiguous()"));
        }
    }

    #[test]
    fn objects_and_long_names_are_refused() {
        let long = |start: &[u8], end: &[u8]| [start, &5000_u32.to_le_bytes(), &[b'x'; 5000], end].concat();
        for (opcodes, expected) in [
            (long(b"}X", b"Ns."), "a key of 5000 bytes, expected at most 4096"),
            (long(b"X", b"X\x01\0\0\0y\x93."), "a Python name of more than 1,000 bytes"),
            (b"}X\x0a\0\0\0state_dictcproject\nThing\n)\x81s.".into(), "`state_dict` is not a dict of tensors"),
            (
                b"}X\x01\0\0\0xcproject\nThing\n)\x81s.".into(),
                "neither the outermost object nor an entry `state_dict` holds tensors",
            ),
            (b"}(((((".into(), "the pickle ends in the middle of"),
            (vec![b'('; 300], "nested deeper than 256 levels"),
            (b"\x8e\xff\xff\xff\xff\xff\xff\xff\xff.".into(), "the pickle ends in the middle of"),
        ] {
            let mut pickle = PickleWriter::new();
            pickle.raw(&opcodes);
            let message = read(pickle).unwrap_err();
            assert!(message.contains(expected), "{message}");
        }
    }
}
