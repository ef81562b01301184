//! Weight files of the VGG networks, made by `scripts/tools/convert_vgg.py`: safetensors, read strictly.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use burn::tensor::{DType, Device, Tensor, TensorData};
use safetensors::{Dtype, SafeTensors};
use sha2::{Digest, Sha256};

use crate::error::ModelError;

/// Largest accepted file; VGG-16 with its heads has 59 MB.
const MAX_BYTES: u64 = 256 << 20;

/// The expected file, and the command that makes the file.
#[derive(Clone, Copy, Debug)]
pub struct WeightFileSpec {
    /// Purpose of the weights, for error messages.
    pub what: &'static str,
    /// Value of `format` in the file's metadata.
    pub format: &'static str,
    pub command: &'static str,
}

/// The tensors of a file. The reader must take every tensor, with the right shape.
pub struct NetworkFile {
    wanted: WeightFileSpec,
    tensors: BTreeMap<String, (Vec<usize>, Vec<f32>)>,
    sha256: String,
    path: PathBuf,
}

impl NetworkFile {
    /// Refuses a file that cannot be read, has another format, or holds values that are not finite f32.
    pub fn read(path: &Path, wanted: WeightFileSpec) -> Result<Self, ModelError> {
        let bad = |reason: String| wanted.bad(reason, path);
        let size = std::fs::metadata(path).map_err(|error| bad(error.to_string()))?.len();
        if size > MAX_BYTES {
            return Err(bad(format!("{size} bytes, expected at most {MAX_BYTES}")));
        }
        let bytes = std::fs::read(path).map_err(|error| bad(error.to_string()))?;
        let (_, metadata) = SafeTensors::read_metadata(&bytes).map_err(|error| bad(error.to_string()))?;
        let format = metadata.metadata().as_ref().and_then(|entries| entries.get("format")).cloned();
        if format.as_deref() != Some(wanted.format) {
            let found = format.unwrap_or_else(|| "none".into());
            return Err(bad(format!("format {found}, expected {}", wanted.format)));
        }
        let file = SafeTensors::deserialize(&bytes).map_err(|error| bad(error.to_string()))?;
        let mut tensors = BTreeMap::new();
        for (name, view) in file.tensors() {
            if view.dtype() != Dtype::F32 {
                return Err(bad(format!("{name} is {:?}, expected F32", view.dtype())));
            }
            let values: Vec<f32> =
                view.data().as_chunks::<4>().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect();
            if values.iter().any(|value| !value.is_finite()) {
                return Err(bad(format!("{name} has a NaN or an infinity")));
            }
            tensors.insert(name, (view.shape().to_vec(), values));
        }
        let sha256 = hex::encode(Sha256::digest(&bytes));
        Ok(Self { wanted, tensors, sha256, path: path.into() })
    }

    pub fn take<const D: usize>(
        &mut self,
        name: &str,
        shape: [usize; D],
        (device, dtype): (&Device, DType),
    ) -> Result<Tensor<D>, ModelError> {
        let Some((found, values)) = self.tensors.remove(name) else {
            return Err(self.wanted.bad(format!("{name} is missing"), &self.path));
        };
        if found != shape {
            return Err(self.wanted.bad(format!("{name} has shape {found:?}, expected {shape:?}"), &self.path));
        }
        Ok(Tensor::from_data(TensorData::new(values, shape), (device, dtype)))
    }

    /// Checks that every tensor was taken, and returns the SHA-256 of the file in 64 hexadecimal digits.
    pub fn finish(self) -> Result<String, ModelError> {
        match self.tensors.keys().next() {
            None => Ok(self.sha256),
            Some(name) => Err(self.wanted.bad(format!("{name} is not part of the network"), &self.path)),
        }
    }
}

impl WeightFileSpec {
    fn bad(self, reason: String, path: &Path) -> ModelError {
        ModelError::BadWeights { what: self.what, reason, command: self.command, path: path.into() }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashMap;

    use safetensors::tensor::TensorView;

    use super::*;
    use crate::testing::to_vec;

    const WANTED: WeightFileSpec = WeightFileSpec { what: "LPIPS", format: "test-1", command: "convert it" };

    fn written(path: &Path, format: &str, values: &[f32]) {
        let bytes: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
        let view = TensorView::new(Dtype::F32, vec![values.len()], &bytes).unwrap();
        let metadata = HashMap::from([("format".to_owned(), format.to_owned())]);
        std::fs::write(path, safetensors::serialize([("head1.weight", view)], Some(metadata)).unwrap()).unwrap();
    }

    #[test]
    fn files_are_taken_completely_and_wrong_ones_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("weights.safetensors");
        let refused = |part: &str, result: Result<NetworkFile, ModelError>| {
            let message = result.err().expect("refused").to_string();
            assert!(message.starts_with("bad weights for LPIPS: ") && message.contains(part), "{message}");
            assert!(message.contains("`convert it`") && message.ends_with("weights.safetensors"), "{message}");
        };
        refused("No such file", NetworkFile::read(&path, WANTED));
        written(&path, "test-1", &[1.0, 2.0]);
        let options = (&Device::flex(), DType::F32);
        let open = || NetworkFile::read(&path, WANTED).unwrap();
        let mut file = open();
        assert_eq!(to_vec(file.take("head1.weight", [2], options).unwrap()), [1.0, 2.0]);
        assert_eq!(file.finish().unwrap().len(), 64);
        let take = |name: &str, len: usize| open().take::<1>(name, [len], options).map(|_| open());
        refused("head2.weight is missing", take("head2.weight", 2));
        refused("expected [3]", take("head1.weight", 3));
        refused("is not part of the network", open().finish().map(|_| open()));
        for len in [std::fs::metadata(&path).unwrap().len() - 2, 0] {
            std::fs::OpenOptions::new().write(true).open(&path).unwrap().set_len(len).unwrap();
            refused("", NetworkFile::read(&path, WANTED));
        }
        written(&path, "test-2", &[1.0]);
        refused("test-2", NetworkFile::read(&path, WANTED));
        written(&path, "test-1", &[f32::NAN]);
        refused("a NaN or an infinity", NetworkFile::read(&path, WANTED));
    }
}
