//! Weights of PyTorch checkpoints: a state dict, on its own or inside the checkpoint of a training program.
//!
//! The pickle is parsed, never executed. Entries beside the state dict (optimiser states, hyper-parameters, callbacks of
//! any class) are skipped. Allocations are bounded by the size of the file.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use clift_core::replace_file;
use half::{bf16, f16};

use crate::error::DataError;
use crate::torch::archive::{Archive, ByteSpan};
use crate::torch::file_kind::require_file;
use crate::torch::pickle::Pickle;
use crate::torch::pickle_writer::PickleWriter;
use crate::torch::tensor_span::{in_row_major_order, storage_stretch, tensor_span};
use crate::torch::values::{ElementType, Tensor, Value};

/// Readable number formats of weights.
const FLOATS: [ElementType; 4] = [ElementType::F32, ElementType::F16, ElementType::BF16, ElementType::F64];
/// Name of the dict beside the state dict in which [`write_state_dict`] stores the sizes of a network.
const SIZES: &str = "clift";
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
    sizes: BTreeMap<String, i64>,
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
        let pickle = Pickle::parse_checkpoint(&bytes, path)?;
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
        let mut sizes = BTreeMap::new();
        if let Some(Value::Dict(items)) = pickle.item(root, SIZES) {
            for (name, size) in items {
                if let (Value::Str(name), Value::Int(size)) = (pickle.get(*name), pickle.get(*size)) {
                    sizes.insert(name.clone(), *size);
                }
            }
        }
        Ok(Self { path: path.into(), num_bytes, skipped_objects: pickle.skipped_objects, archive, tensors, sizes })
    }

    /// Returns the keys, sorted.
    pub fn keys(&self) -> impl Iterator<Item = &str> {
        self.tensors.keys().map(String::as_str)
    }

    /// Returns a size of the network that [`write_state_dict`] stored beside the tensors.
    pub fn size(&self, name: &str) -> Option<i64> {
        self.sizes.get(name).copied()
    }

    /// Returns number format and shape of a tensor; `None` for a missing key or another value.
    pub fn tensor(&self, key: &str) -> Option<(ElementType, &[u64])> {
        let tensor = self.tensors.get(key)?.as_ref()?;
        Some((tensor.storage.element_type, &tensor.shape))
    }

    /// Reads a tensor of floats as f32, row-major. Elements in another order (transposed, channels-last) are reordered.
    ///
    /// # Errors
    /// [`DataError::BadCheckpoint`] for a key without a tensor of floats, an expanded tensor, a tensor that exceeds its
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
        // Tensors in another order: read the stretch from the first to the last element.
        let is_contiguous = tensor.is_contiguous();
        let stored = if is_contiguous { tensor.clone() } else { storage_stretch(tensor).map_err(bad)? };
        let shape: Vec<Option<u64>> = stored.shape.iter().map(|size| Some(*size)).collect();
        let value = Value::Tensor(Box::new(stored));
        let (span, element_type): (ByteSpan, ElementType) =
            tensor_span(&value, &shape, &FLOATS, &self.archive).map_err(bad)?;
        let bytes = span.read(&self.path).map_err(|error| match error {
            DataError::BadChunk { what, .. } => bad(what),
            other => as_checkpoint(other),
        })?;
        let mut values = to_f32(&bytes, element_type);
        if !is_contiguous {
            values = in_row_major_order(&values, &tensor.shape, &tensor.stride);
        }
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

/// Writes `{"clift": {name: size}, "state_dict": {key: tensor}}` in f32 for `torch.load(path, weights_only=True)`; the
/// entry `clift` only with sizes.
///
/// # Errors
/// [`DataError::Io`]; the former file is then unchanged.
pub fn write_state_dict(
    path: &Path,
    tensors: &[(String, Vec<usize>, Vec<f32>)],
    sizes: &[(&str, usize)],
) -> Result<(), DataError> {
    let mut pickle = PickleWriter::new();
    pickle.raw(b"}(");
    if !sizes.is_empty() {
        pickle.string(SIZES);
        pickle.raw(b"}(");
        for (name, size) in sizes {
            pickle.string(name);
            pickle.integer(*size);
        }
        pickle.raw(b"u");
    }
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
    fn lightning_checkpoints_give_their_tensors() {
        let state = StateDict::open(&fixture("re10k.ckpt")).unwrap();
        assert_eq!(state.tensor("transformer.linear_input.weight"), Some((ElementType::F32, &[15, 576, 1, 1][..])));
        assert_eq!(state.tensor("transformer.squeezer.linear1.bias"), Some((ElementType::F32, &[15][..])));
        assert_eq!(state.tensor("perceptual_loss.vgg.features.0.weight").unwrap().1, [4, 3, 3, 3]);
        assert_eq!(state.tensor("optimizer_states"), None);
        assert_eq!(state.read("transformer.linear_input.weight").unwrap().len(), 15 * 576);
        for name in ["project.config.ModelConfig", "project.config.Mode", "functools.partial", "torch.BoolStorage"] {
            assert!(state.skipped_objects.contains(name), "{:?}", state.skipped_objects);
        }
    }

    #[test]
    fn f16_and_bf16_are_read_as_f32() {
        let [half, full] = ["half.ckpt", "re10k_first.ckpt"].map(|name| StateDict::open(&fixture(name)).unwrap());
        let mut kinds = BTreeSet::new();
        for key in half.keys() {
            kinds.insert(format!("{:?}", half.tensor(key).unwrap().0));
            for (half, full) in half.read(key).unwrap().iter().zip(full.read(key).unwrap()) {
                // Eleven and eight bits; the smallest of f16 are coarser.
                assert!((half - full).abs() <= full.abs() / 256.0 + 1e-7, "{key}: {half} for {full}");
            }
        }
        assert_eq!(kinds, BTreeSet::from(["BF16".into(), "F16".into()]));
    }

    #[test]
    fn written_tensors_are_read_back() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.ckpt");
        let tensors =
            [("x.y".to_owned(), vec![2, 3], vec![1.0, -2.0, 3.5, 0.0, 1e-30, 5.0]), ("z".into(), vec![1], vec![7.0])];
        write_state_dict(&path, &tensors, &[("num_heads", 3)]).unwrap();
        let state = StateDict::open(&path).unwrap();
        assert_eq!(state.keys().collect::<Vec<_>>(), ["x.y", "z"]);
        assert_eq!((state.size("num_heads"), state.size("dim")), (Some(3), None));
        for (key, shape, values) in tensors {
            let shape: Vec<u64> = shape.into_iter().map(|size| size as u64).collect();
            assert_eq!(state.tensor(&key), Some((ElementType::F32, &shape[..])));
            assert_eq!(state.read(&key).unwrap(), values);
        }
    }

    #[test]
    fn non_finite_values_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.ckpt");
        write_state_dict(&path, &[("x".into(), vec![2], vec![1.0, f32::NAN])], &[]).unwrap();
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
        // Reading a tensor checks its checksum.
        let mut damaged = whole.clone();
        damaged[whole.len() / 2] ^= 1;
        std::fs::write(&path, &damaged).unwrap();
        let state = StateDict::open(&path).unwrap();
        let read: Vec<_> = state.keys().map(|key| state.read(key)).collect();
        assert!(read.iter().any(|result| matches!(result, Err(DataError::BadCheckpoint { .. }))));
        let chunk = fixture("../re10k-mini/test/000000.torch");
        let message = StateDict::open(&chunk).map(|_| ()).unwrap_err().to_string();
        assert!(message.contains("the outermost object is not a dict of tensors"), "{message}");
        let message = StateDict::open(&fixture("none.ckpt")).map(|_| ()).unwrap_err().to_string();
        assert!(message.starts_with("opening the checkpoint failed"), "{message}");
    }

    /// Opens a checkpoint of this pickle, and its tensor `x` if there is one.
    fn read(pickle: PickleWriter) -> Result<Vec<f32>, String> {
        let read = |path: &Path| StateDict::open(path).and_then(|state| state.read("x"));
        read_from_file("a.ckpt", pickle.pack("a").unwrap(), read).map_err(|error| error.to_string())
    }

    fn refused(opcodes: &[u8]) -> String {
        let mut pickle = PickleWriter::new();
        pickle.raw(opcodes);
        read(pickle).unwrap_err()
    }

    /// A checkpoint with a tensor `x` of 0, 1, 2, .. in these shapes and strides.
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
    fn strided_tensors_are_reordered() {
        assert_eq!(strided(&[2, 3], &[1, 2]), Ok(vec![0.0, 2.0, 4.0, 1.0, 3.0, 5.0]));
        // Channels-last, of two pixels.
        assert_eq!(strided(&[1, 3, 2, 1], &[6, 1, 3, 3]), Ok(vec![0.0, 3.0, 1.0, 4.0, 2.0, 5.0]));
        assert_eq!(strided(&[2, 2], &[12, 3]), Ok(vec![0.0, 3.0, 12.0, 15.0]), "a part of a larger one");
        let (big, huge) = (1 << 40, 1 << 61);
        for (shape, stride) in [
            (&[4, 7][..], &[1, 4][..]),
            (&[2, huge], &[1, 2]),
            (&[3, 3], &[1, 1 << 62]),
            (&[big, big], &[big, 1]),
            (&[1 << 31], &[1]),
            (&[25], &[1]),
        ] {
            let message = strided(shape, stride).unwrap_err();
            assert!(message.starts_with("bad checkpoint: x [") && message.contains("exceeds its storage"), "{message}");
        }
        assert_eq!(strided(&[2, 1 << 40, 0], &[1, 0, 1]), Ok(vec![]), "no element, whatever the strides");
        for (shape, stride) in [([1 << 40, 2], [0, 1]), ([4, 4], [1, 1])] {
            assert!(strided(&shape, &stride).unwrap_err().contains("tensor.contiguous()"));
        }
    }

    #[test]
    fn long_names_which_would_be_copied_at_every_use_are_refused() {
        let long = |start: &[u8], end: &[u8]| [start, &5000_u32.to_le_bytes(), &[b'x'; 5000], end].concat();
        assert!(refused(&long(b"}X", b"Ns.")).contains("a key of 5000 bytes, expected at most 4096"));
        assert!(refused(&long(b"X", b"X\x01\0\0\0y\x93.")).contains("a Python name of more than 1,000 bytes"));
    }

    #[test]
    fn objects_are_no_tensors() {
        let message = refused(b"}X\x0a\0\0\0state_dictcproject\nThing\n)\x81s.");
        assert!(message.contains("`state_dict` is not a dict of tensors"), "{message}");
        let message = refused(b"}X\x01\0\0\0xcproject\nThing\n)\x81s.");
        assert!(message.contains("neither the outermost object nor an entry `state_dict` holds tensors"), "{message}");
        assert!(refused(b"}(((((").contains("the pickle ends in the middle of"));
        assert!(refused(&[b'('; 300]).contains("nested deeper than 256 levels"));
        assert!(refused(b"\x8e\xff\xff\xff\xff\xff\xff\xff\xff.").contains("the pickle ends in the middle of"));
    }
}
