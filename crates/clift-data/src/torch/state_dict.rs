//! The weights of a PyTorch checkpoint: what `torch.save` wrote of a state dict, on its own or inside a training
//! program's checkpoint.
//!
//! The pickle is read, never executed. Whatever stands beside the state dict (optimiser states, hyper-parameters,
//! callbacks of any class) is passed over; sizes are those of the file, so nothing is allocated that it does not hold.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use half::{bf16, f16};

use crate::error::DataError;
use crate::files::atomic::replace;
use crate::torch::archive::{Archive, ByteSpan};
use crate::torch::file_kind::refuse_others;
use crate::torch::pickle::Pickle;
use crate::torch::pickle_writer::PickleWriter;
use crate::torch::tensor_span::{in_row_major_order, storage_stretch, tensor_span};
use crate::torch::values::{ElementType, MAX_BYTES, Tensor, Value};

/// Number formats that weights can be read from.
const FLOATS: [ElementType; 4] = [ElementType::F32, ElementType::F16, ElementType::BF16, ElementType::F64];

/// The dict beside the state dict in which [`write_state_dict`] puts the sizes of a network.
const SIZES: &str = "clift";

/// An open checkpoint. Tensors stay in the file.
pub struct StateDict {
    path: PathBuf,
    archive: Archive,
    tensors: BTreeMap<String, Option<Tensor>>,
    sizes: BTreeMap<String, i64>,
    passed_over: BTreeSet<String>,
    num_bytes: u64,
}

impl StateDict {
    /// Opens a file whose outermost object is a dict with `state_dict` in it, or a state dict itself.
    ///
    /// # Errors
    /// [`DataError::BadCheckpoint`] for a file that is truncated, something else or without a state dict,
    /// [`DataError::BadPickle`] and [`DataError::RefusedGlobal`] for a pickle that is malformed or an attack.
    pub fn open(path: &Path) -> Result<Self, DataError> {
        let bad = |what: String| DataError::BadCheckpoint { what, path: path.to_path_buf() };
        refuse_others(path)?;
        let num_bytes = std::fs::metadata(path).map_err(DataError::io("opening the checkpoint", path))?.len();
        let archive = Archive::open(path).map_err(as_checkpoint)?;
        let member = archive
            .member("data.pkl")
            .ok_or_else(|| bad("no member data.pkl, so torch.save did not write it".into()))?;
        if member.len() > MAX_BYTES as u64 {
            return Err(bad(format!("data.pkl has {} bytes, more than the limit of {MAX_BYTES}", member.len())));
        }
        let bytes = member.read(path).map_err(as_checkpoint)?;
        let pickle = Pickle::parse_checkpoint(&bytes, path)?;
        let root = pickle.root();
        let state = pickle.item(root, "state_dict").unwrap_or(root);
        let Value::Dict(items) = state else {
            let place = if pickle.item(root, "state_dict").is_some() { "`state_dict`" } else { "the outermost object" };
            return Err(bad(format!("{place} is no dict of tensors")));
        };
        let mut tensors = BTreeMap::new();
        for (key, value) in items {
            // Keys that are no strings belong to no state dict.
            if let Value::Str(key) = pickle.get(*key) {
                let tensor = match pickle.get(*value) {
                    Value::Tensor(tensor) => Some((**tensor).clone()),
                    _ => None,
                };
                tensors.insert(key.clone(), tensor);
            }
        }
        if tensors.values().all(Option::is_none) {
            return Err(bad("neither it nor an entry `state_dict` in it holds tensors".into()));
        }
        let mut sizes = BTreeMap::new();
        if let Some(Value::Dict(items)) = pickle.item(root, SIZES) {
            for (name, size) in items {
                if let (Value::Str(name), Value::Int(size)) = (pickle.get(*name), pickle.get(*size)) {
                    sizes.insert(name.clone(), *size);
                }
            }
        }
        let passed_over = pickle.passed_over().clone();
        Ok(Self { path: path.into(), archive, tensors, sizes, passed_over, num_bytes })
    }

    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Its size.
    pub fn num_bytes(&self) -> u64 {
        self.num_bytes
    }

    /// Every key, in alphabetical order.
    pub fn keys(&self) -> impl Iterator<Item = &str> {
        self.tensors.keys().map(String::as_str)
    }

    /// Names of classes and functions that the file holds beside its tensors and that were passed over unread.
    pub fn passed_over(&self) -> &BTreeSet<String> {
        &self.passed_over
    }

    /// A size of the network that this program wrote beside the tensors.
    pub fn size(&self, name: &str) -> Option<i64> {
        self.sizes.get(name).copied()
    }

    /// Number format and shape of a tensor; `None` for a key that is missing or holds something else.
    pub fn tensor(&self, key: &str) -> Option<(ElementType, &[u64])> {
        let tensor = self.tensors.get(key)?.as_ref()?;
        Some((tensor.storage.element_type, &tensor.shape))
    }

    /// Reads a tensor of floats, row-major, converted to f32. One that lies in its storage in another order, transposed
    /// or channels-last, is put into that order.
    ///
    /// # Errors
    /// [`DataError::BadCheckpoint`] for a key without a tensor of floats, one that is expanded, lies outside its storage
    /// or holds a value that is not finite in f32.
    pub fn read(&self, key: &str) -> Result<Vec<f32>, DataError> {
        let Some(Some(tensor)) = self.tensors.get(key) else {
            let what = format!("{}: no tensor", key.escape_debug());
            return Err(DataError::BadCheckpoint { what, path: self.path.clone() });
        };
        let bad = |what: String| {
            let what = format!("{} {:?}: {what}", key.escape_debug(), tensor.shape);
            DataError::BadCheckpoint { what, path: self.path.clone() }
        };
        // Of a tensor in another order, all from its first element to its last.
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

/// The archive reader speaks of chunks.
fn as_checkpoint(error: DataError) -> DataError {
    match error {
        DataError::BadChunk { what, path } => DataError::BadCheckpoint { what, path },
        DataError::Io { source, path, .. } => DataError::Io { action: "reading the checkpoint", source, path },
        other => other,
    }
}

/// Writes `{"state_dict": {key: tensor}, "clift": {name: size}}` in f32 so that `torch.load(path, weights_only=True)`
/// reads it; without sizes, without the second.
///
/// # Errors
/// [`DataError::Io`]; the file is then as it was.
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
    replace(path, &bytes).map_err(DataError::io("writing a checkpoint", path))
}

#[cfg(test)]
mod tests {
    use safetensors::SafeTensors;

    use super::*;

    fn fixture(name: &str) -> PathBuf {
        PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../data-fixtures/checkpoints").join(name)
    }

    #[test]
    fn a_lightning_checkpoint_gives_its_tensors_and_passes_over_the_rest() {
        let state = StateDict::open(&fixture("re10k.ckpt")).unwrap();
        assert_eq!(state.tensor("transformer.linear_input.weight"), Some((ElementType::F32, &[15, 576, 1, 1][..])));
        assert_eq!(state.tensor("transformer.squeezer.linear1.bias"), Some((ElementType::F32, &[15][..])));
        assert_eq!(state.tensor("perceptual_loss.vgg.features.0.weight").unwrap().1, [4, 3, 3, 3]);
        assert_eq!(state.tensor("optimizer_states"), None);
        assert_eq!(state.read("transformer.linear_input.weight").unwrap().len(), 15 * 576);
        for name in ["project.config.ModelConfig", "project.config.Mode", "functools.partial", "torch.BoolStorage"] {
            assert!(state.passed_over().contains(name), "{:?}", state.passed_over());
        }
    }

    #[test]
    fn half_precision_is_read_as_the_nearest_numbers() {
        let (half, full) = (fixture("half.ckpt"), fixture("re10k_first.ckpt"));
        let (half, full) = (StateDict::open(&half).unwrap(), StateDict::open(&full).unwrap());
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
    fn what_is_written_is_read_back() {
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
    fn values_that_are_not_finite_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.ckpt");
        write_state_dict(&path, &[("x".into(), vec![2], vec![1.0, f32::NAN])], &[]).unwrap();
        let message = StateDict::open(&path).unwrap().read("x").unwrap_err().to_string();
        assert!(message.starts_with("bad checkpoint: x [2]: value 1 is NaN: "), "{message}");
    }

    #[test]
    fn truncated_files_and_files_of_something_else_are_errors() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.ckpt");
        let whole = std::fs::read(fixture("re10k_first.ckpt")).unwrap();
        for length in (0..whole.len()).step_by(whole.len() / 40) {
            std::fs::write(&path, &whole[..length]).unwrap();
            let message = StateDict::open(&path).map(|_| ()).unwrap_err().to_string();
            assert!(message.starts_with("bad checkpoint: ") && message.ends_with("a.ckpt"), "{message}");
        }
        // A damaged byte of a tensor is found when it is read.
        let mut damaged = whole.clone();
        damaged[whole.len() / 2] ^= 1;
        std::fs::write(&path, &damaged).unwrap();
        let state = StateDict::open(&path).unwrap();
        let read: Vec<_> = state.keys().map(|key| state.read(key)).collect();
        assert!(read.iter().any(|result| matches!(result, Err(DataError::BadCheckpoint { .. }))));

        let chunk = fixture("../re10k-mini/test/000000.torch");
        let message = StateDict::open(&chunk).map(|_| ()).unwrap_err().to_string();
        assert!(message.contains("the outermost object is no dict of tensors"), "{message}");
        let message = StateDict::open(&fixture("none.ckpt")).map(|_| ()).unwrap_err().to_string();
        assert!(message.starts_with("opening the checkpoint failed"), "{message}");
    }

    /// A checkpoint around this pickle, without storages.
    fn packed(pickle: &[u8]) -> (tempfile::TempDir, PathBuf) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.ckpt");
        let mut writer = PickleWriter::new();
        writer.raw(pickle);
        std::fs::write(&path, writer.pack("a").unwrap()).unwrap();
        (folder, path)
    }

    fn refused(pickle: &[u8]) -> String {
        let (_folder, path) = packed(pickle);
        StateDict::open(&path).map(|_| ()).unwrap_err().to_string()
    }

    #[test]
    fn attacks_are_refused_by_name_and_nothing_is_run() {
        for name in ["os\nsystem", "posix\nsystem", "subprocess\nPopen", "builtins\neval", "builtins\nexec"] {
            let pickle = [b"}X\x05\0\0\0hyperc", name.as_bytes(), b"\nX\x02\0\0\0ls\x85Rs."].concat();
            let message = refused(&pickle);
            assert!(message.contains(&name.replace('\n', ".")) && message.contains("nothing was run"), "{message}");
        }
    }

    /// A checkpoint with a tensor `x` of 0, 1, 2, .. in these shapes and strides.
    fn strided(shape: &[usize], stride: &[usize]) -> Result<Vec<f32>, String> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.ckpt");
        let mut pickle = PickleWriter::new();
        pickle.raw(b"}");
        pickle.string("x");
        let storage = (0..24_u8).flat_map(|value| f32::from(value).to_le_bytes()).collect();
        pickle.strided_tensor("FloatStorage", storage, shape, stride);
        pickle.raw(b"s.");
        std::fs::write(&path, pickle.pack("a").unwrap()).unwrap();
        StateDict::open(&path).unwrap().read("x").map_err(|error| error.to_string())
    }

    #[test]
    fn tensors_in_another_order_are_put_into_theirs() {
        assert_eq!(strided(&[2, 3], &[1, 2]), Ok(vec![0.0, 2.0, 4.0, 1.0, 3.0, 5.0]));
        // Channels-last, of two pixels.
        assert_eq!(strided(&[1, 3, 2, 1], &[6, 1, 3, 3]), Ok(vec![0.0, 3.0, 1.0, 4.0, 2.0, 5.0]));
        assert_eq!(strided(&[2, 2], &[12, 3]), Ok(vec![0.0, 3.0, 12.0, 15.0]), "a part of a larger one");
        for (shape, stride) in [([4, 7], [1, 4]), ([2, 1 << 61], [1, 2]), ([3, 3], [1, 1 << 62])] {
            let message = strided(&shape, &stride).unwrap_err();
            assert!(message.starts_with("bad checkpoint: x [") && message.contains("exceeds its storage"), "{message}");
        }
        for (shape, stride) in [([1 << 40, 2], [0, 1]), ([4, 4], [1, 1])] {
            assert!(strided(&shape, &stride).unwrap_err().contains("tensor.contiguous()"));
        }
    }

    #[test]
    fn sizes_that_the_file_does_not_hold_are_errors() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.ckpt");
        for (shape, what) in [
            (vec![1 << 40, 1 << 40], "exceeds its storage"),
            (vec![1 << 31], "exceeds its storage"),
            (vec![3], "exceeds its storage"),
        ] {
            let mut pickle = PickleWriter::new();
            pickle.raw(b"}");
            pickle.string("x");
            pickle.tensor("FloatStorage", vec![0; 8], &shape);
            pickle.raw(b"s.");
            std::fs::write(&path, pickle.pack("a").unwrap()).unwrap();
            let message = StateDict::open(&path).unwrap().read("x").unwrap_err().to_string();
            assert!(message.contains(what), "{message}");
        }
    }

    #[test]
    fn objects_in_the_place_of_tensors_are_no_tensors() {
        let message = refused(b"}X\x0a\0\0\0state_dictcproject\nThing\n)\x81s.");
        assert!(message.contains("`state_dict` is no dict of tensors"), "{message}");
        let message = refused(b"}X\x01\0\0\0xcproject\nThing\n)\x81s.");
        assert!(message.contains("neither it nor an entry `state_dict` in it holds tensors"), "{message}");
        assert!(refused(b"}(((((").contains("it ends in the middle of"));
        assert!(refused(&[b'('; 300]).contains("nested deeper than 256 levels"));
        assert!(refused(b"\x8e\xff\xff\xff\xff\xff\xff\xff\xff.").contains("it ends in the middle of"));
    }

    #[test]
    fn the_values_are_those_that_torch_saved() {
        // `make_checkpoints.py` draws the first of re10k_first in float64 and rounds it to f32: what it computes with
        // them is in the safetensors file, which the import's tests compare; here only that both can be opened.
        let bytes = std::fs::read(fixture("re10k_first.safetensors")).unwrap();
        let sizes = SafeTensors::deserialize(&bytes).unwrap().tensor("input.sizes").unwrap().data().to_vec();
        let state = StateDict::open(&fixture("re10k_first.ckpt")).unwrap();
        let dim = u64::from(sizes[0]);
        assert_eq!(state.tensor("transformer.output_norm.weight").unwrap().1, [dim]);
    }
}
