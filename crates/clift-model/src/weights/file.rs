//! Weight files: safetensors in PyTorch's layout.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Cursor, Read, Seek, SeekFrom, Write};
use std::path::Path;

use burn::module::Module;
use burn::store::{
    ApplyError, BurnToPyTorchAdapter, ModuleSnapshot, PathFilter, PyTorchToBurnAdapter, SafetensorsStore,
};
use burn::tensor::DType;

use crate::error::ModelError;
use crate::files::{TEMPORARY, folder_of, publish};
use crate::weights::hash::visit;

/// Which parameters of a file went into a module.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct LoadReport {
    /// Parameters that were set from the file.
    pub applied: Vec<String>,
    /// Parameters of the module that the file lacks; they keep their values.
    pub missing: Vec<String>,
    /// Tensors of the file that the module has no place for.
    pub unused: Vec<String>,
}

impl LoadReport {
    /// Demands that file and module hold the same parameters.
    ///
    /// # Errors
    /// [`ModelError::Weights`] with the first few names that differ.
    pub fn require_all(&self, path: &Path) -> Result<(), ModelError> {
        if self.missing.is_empty() && self.unused.is_empty() {
            return Ok(());
        }
        let some = |names: &[String]| names.iter().take(3).cloned().collect::<Vec<_>>().join(", ");
        let reason = format!(
            "the file does not hold this model: {} parameters missing ({}), {} without a place ({})",
            self.missing.len(),
            some(&self.missing),
            self.unused.len(),
            some(&self.unused)
        );
        Err(ModelError::Weights { action: "reading", reason, path: path.into() })
    }
}

/// Writes the parameters of a module under the names and in the layout PyTorch gives them
/// (linear weights `[outputs, inputs]`), to a temporary name that is then renamed. Equal weights are equal files.
///
/// # Errors
/// [`ModelError::Weights`].
pub fn save_weights<M: Module>(module: &M, path: &Path) -> Result<(), ModelError> {
    save_part(module, &PathFilter::all(), path)
}

/// Does [`save_weights`] for the parameters whose paths match `part`. The file equals that of a module without the others.
///
/// # Errors
/// As [`save_weights`].
pub fn save_part<M: Module>(module: &M, part: &PathFilter, path: &Path) -> Result<(), ModelError> {
    let error = |reason: String| ModelError::Weights { action: "writing", reason, path: path.into() };
    // The store and the crate below it have temporary names of their own, which a kill leaves behind: in a folder whose
    // name is known. On an error it goes, as on a full disk it must.
    let folder = tempfile::Builder::new().prefix(TEMPORARY).tempdir_in(folder_of(path));
    let folder = folder.map_err(|e| error(e.to_string()))?;
    let temporary = folder.path().join("model.safetensors");
    let mut store = SafetensorsStore::from_file(&temporary)
        .with_to_adapter(BurnToPyTorchAdapter)
        .filter(part.clone())
        .overwrite(true)
        .metadata("format", "clift-1");
    module.save_into(&mut store).map_err(|e| error(e.to_string()))?;
    let sorted = File::options().read(true).write(true).open(&temporary).and_then(|mut file| sort_header(&mut file));
    sorted.and_then(|()| publish(&temporary, path)).map_err(|e| error(e.to_string()))
}

/// Writes a safetensors header anew with its keys sorted: Burn's store orders them at random, file by file. The
/// tensors' bytes stay where they are.
fn sort_header(file: &mut (impl Read + Write + Seek)) -> std::io::Result<()> {
    let mut length = [0; 8];
    file.read_exact(&mut length)?;
    let length = u64::from_le_bytes(length);
    let mut header = vec![0; usize::try_from(length).map_err(std::io::Error::other)?];
    file.read_exact(&mut header)?;
    let entries: BTreeMap<String, BTreeMap<String, serde_json::Value>> = serde_json::from_slice(&header)?;
    let mut sorted = serde_json::to_vec(&entries)?;
    if sorted.len() > header.len() {
        return Err(std::io::Error::other("the header has no room for itself with its keys sorted"));
    }
    sorted.resize(header.len(), b' ');
    file.seek(SeekFrom::Start(8))?;
    file.write_all(&sorted)
}

/// Sorts the header of a safetensors file that is still in memory.
///
/// # Errors
/// For bytes that are no safetensors file.
pub fn sorted_header(mut bytes: Vec<u8>) -> std::io::Result<Vec<u8>> {
    sort_header(&mut Cursor::new(&mut bytes[..]))?;
    Ok(bytes)
}

/// Reads parameters written by [`save_weights`] into a module and says which.
///
/// # Errors
/// [`ModelError::Weights`] when the file cannot be read, a shape differs, or a value is not finite or no 32-bit
/// float.
pub fn load<M: Module>(module: &mut M, path: &Path) -> Result<LoadReport, ModelError> {
    load_part(module, &PathFilter::all(), path)
}

/// Does [`load`] for the parameters whose paths match `part`. Tensors of the file that do not match are unused.
///
/// # Errors
/// As [`load`].
pub fn load_part<M: Module>(module: &mut M, part: &PathFilter, path: &Path) -> Result<LoadReport, ModelError> {
    read(module, SafetensorsStore::from_file(path).filter(part.clone()), part, path)
}

/// Reads the module `name` of a larger one, such as the `renderer` of a whole model, without the others.
///
/// # Errors
/// As [`load`].
pub fn load_module<M: Module>(module: &mut M, name: &str, path: &Path) -> Result<LoadReport, ModelError> {
    let store = SafetensorsStore::from_file(path).with_key_remapping(format!("^{name}\\."), "");
    read(module, store, &PathFilter::all(), path)
}

fn read<M: Module>(
    module: &mut M,
    store: SafetensorsStore,
    part: &PathFilter,
    path: &Path,
) -> Result<LoadReport, ModelError> {
    let error = |reason: String| ModelError::Weights { action: "reading", reason, path: path.into() };
    if !path.is_file() {
        return Err(error("there is no such file".into()));
    }
    let mut store = store.with_from_adapter(PyTorchToBurnAdapter).validate(false).allow_partial(true);
    let result = module.load_from(&mut store).map_err(|e| error(e.to_string()))?;
    if let Some(first) = result.errors.first() {
        return Err(error(told(first)));
    }
    if let Some((name, dtype)) = first_not_f32(module) {
        return Err(error(format!("{name} is {dtype:?}, not F32")));
    }
    if let Some(name) = first_non_finite(module) {
        return Err(error(format!("{name} is not finite")));
    }
    // Burn counts an absent parameter as missing whether it matches or not.
    let missing = result.missing.iter().filter(|(name, _)| part.matches(name));
    let missing = missing.map(|(name, _)| name_in_file(name)).collect();
    let mut unused = result.unused;
    unused.extend(result.skipped.iter().map(|name| name_in_file(name)));
    unused.sort();
    Ok(LoadReport { applied: result.applied, missing, unused })
}

/// The name that a parameter of a module has in a file: Burn calls those of norms otherwise.
fn name_in_file(path: &str) -> String {
    for (here, there) in [(".gamma", ".weight"), (".beta", ".bias")] {
        if let Some(module) = path.strip_suffix(here) {
            return format!("{module}{there}");
        }
    }
    path.to_owned()
}

/// Why a tensor was not taken, with shapes as files hold them: Burn keeps the weights of linear layers, which are all
/// matrices there are, as `[inputs, outputs]`.
fn told(error: &ApplyError) -> String {
    let ApplyError::ShapeMismatch { path, expected, found } = error else { return error.to_string() };
    let [expected, found] = [expected, found].map(|shape| {
        let mut sizes = shape.to_vec();
        sizes.reverse(); // of a vector, nothing
        sizes
    });
    format!("{} is {found:?}, expected {expected:?}", name_in_file(path))
}

/// Path of the first parameter with a NaN or an infinity.
pub fn first_non_finite<M: Module>(module: &M) -> Option<String> {
    let mut found = None;
    visit(module, |name, _, data| {
        if found.is_none() && data.iter::<f32>().any(|value| !value.is_finite()) {
            found = Some(name.to_owned());
        }
    });
    found
}

/// Path and type of the first parameter that does not hold 32-bit floats.
pub fn first_not_f32<M: Module>(module: &M) -> Option<(String, DType)> {
    let mut found = None;
    visit(module, |name, _, data| {
        if found.is_none() && data.dtype() != DType::F32 {
            found = Some((name.to_owned(), data.dtype()));
        }
    });
    found
}

#[cfg(test)]
mod tests {
    use crate::weights::hash::weights_hash;
    use burn::tensor::Device;

    use super::*;
    use crate::network::clift::Clift;
    use crate::network::config::ModelConfig;

    fn model(seed: u64) -> Clift {
        let config = ModelConfig {
            dim: 16,
            num_heads: 2,
            feed_forward_dim: 24,
            num_encoder_blocks: 1,
            num_renderer_blocks: 1,
            ..ModelConfig::default()
        };
        Clift::new(&config, seed, &Device::flex())
    }

    #[test]
    fn weights_survive_a_file_to_the_bit() {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let path = directory.path().join("model.safetensors");
        save_weights(&model(1), &path).expect("writes");
        let mut other = model(2);
        assert_ne!(weights_hash(&other), weights_hash(&model(1)));
        load(&mut other, &path).expect("reads").require_all(&path).expect("the same model");
        assert_eq!(weights_hash(&other), weights_hash(&model(1)));
        // Nothing else is left, and whoever may read other files may read it.
        let usual = directory.path().join("usual");
        File::create(&usual).expect("writes");
        let permissions = |path: &Path| std::fs::metadata(path).expect("there").permissions();
        assert_eq!(permissions(&path), permissions(&usual));
        assert_eq!(std::fs::read_dir(directory.path()).expect("a folder").count(), 2);
    }

    #[test]
    fn a_file_of_another_model_is_named_with_what_differs() {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let path = directory.path().join("model.safetensors");
        save_weights(&model(1).encoder, &path).expect("writes");
        let loaded = load(&mut model(2), &path).expect("nothing fits, nothing breaks");
        let message = loaded.require_all(&path).unwrap_err().to_string();
        assert!(message.contains("86 parameters missing (condenser.blocks.0"), "{message}");
    }

    #[test]
    fn equal_weights_are_equal_files_in_a_header_that_others_read() {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let files: Vec<Vec<u8>> = (0..4)
            .map(|i| {
                let path = directory.path().join(format!("{i}.safetensors"));
                save_weights(&model(1), &path).expect("writes");
                std::fs::read(path).expect("reads")
            })
            .collect();
        // Of three keys in any order, four files would agree once in 216 times.
        assert!(files.iter().all(|bytes| *bytes == files[0]));
        let (_, header) = safetensors::SafeTensors::read_metadata(&files[0]).expect("valid");
        let metadata = header.metadata().as_ref().expect("there");
        assert!(metadata.len() >= 2 && metadata["format"] == "clift-1", "{metadata:?}");
        assert_eq!(std::fs::read_dir(directory.path()).expect("a folder").count(), 4, "nothing else is left");
    }

    #[test]
    fn names_and_shapes_in_messages_are_those_of_the_file() {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let path = directory.path().join("model.safetensors");
        save_weights(&model(1).encoder, &path).expect("writes");
        let missing = load(&mut model(2), &path).expect("nothing fits, nothing breaks").missing;
        assert!(missing.iter().any(|name| name == "renderer.output_norm.weight"), "{missing:?}");
        assert!(!missing.iter().any(|name| name.contains(".gamma") || name.contains(".beta")), "{missing:?}");

        save_weights(&model(1), &path).expect("writes");
        let config = ModelConfig {
            dim: 16,
            num_heads: 2,
            feed_forward_dim: 20,
            num_encoder_blocks: 1,
            num_renderer_blocks: 1,
            ..ModelConfig::default()
        };
        let mut narrow = Clift::new(&config, 0, &Device::flex());
        let message = load(&mut narrow, &path).unwrap_err().to_string();
        let file = std::fs::read(&path).expect("reads");
        let file = safetensors::SafeTensors::deserialize(&file).expect("valid");
        let name = file.names().into_iter().find(|name| message.contains(&format!("{name} is "))).expect("its name");
        let got = format!("{name} is {:?}, expected ", file.tensor(name).expect("there").shape());
        assert!(message.contains(&got), "{got}\nis not in\n{message}");
        let shapes = ["is [24], expected [20]", "is [24, 16], expected [20, 16]", "is [16, 24], expected [16, 20]"];
        assert!(shapes.iter().any(|shapes| message.contains(shapes)), "{message}");
    }

    #[test]
    fn truncated_and_missing_files_are_errors() {
        let directory = tempfile::tempdir().expect("a temporary directory");
        let path = directory.path().join("model.safetensors");
        assert!(load(&mut model(1), &path).unwrap_err().to_string().contains("no such file"));
        save_weights(&model(1), &path).expect("writes");
        let bytes = std::fs::read(&path).expect("reads");
        std::fs::write(&path, &bytes[..bytes.len() / 2]).expect("writes");
        assert!(load(&mut model(1), &path).is_err());
    }
}
