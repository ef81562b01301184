//! Weight files: safetensors in PyTorch's layout, and the hash that names a set of weights.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Cursor, ErrorKind, Read, Seek, SeekFrom, Write};
use std::path::Path;

use burn::module::{Module, ModuleVisitor, Param};
use burn::store::{ApplyError, BurnToPyTorchAdapter, ModuleSnapshot, PyTorchToBurnAdapter, SafetensorsStore};
use burn::tensor::{DType, Tensor, TensorData};
use sha2::{Digest, Sha256};

use crate::{ModelConfig, ModelError, Renderer};

/// Which parameters of a file went into a module.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Loaded {
    /// Parameters that were set from the file.
    pub applied: Vec<String>,
    /// Parameters of the module that the file lacks; they keep their values.
    pub missing: Vec<String>,
    /// Tensors of the file that the module has no place for.
    pub unused: Vec<String>,
}

impl Loaded {
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
pub fn save<M: Module>(module: &M, path: &Path) -> Result<(), ModelError> {
    let error = |reason: String| ModelError::Weights { action: "writing", reason, path: path.into() };
    // The store and the crate below it have temporary names of their own, which a kill leaves behind: in a folder whose
    // name is known. On an error it goes, as on a full disk it must.
    let folder = tempfile::Builder::new().prefix(TEMPORARY).tempdir_in(folder_of(path));
    let folder = folder.map_err(|e| error(e.to_string()))?;
    let temporary = folder.path().join("model.safetensors");
    let mut store = SafetensorsStore::from_file(&temporary)
        .with_to_adapter(BurnToPyTorchAdapter)
        .overwrite(true)
        .metadata("format", "clift-1");
    module.save_into(&mut store).map_err(|e| error(e.to_string()))?;
    publish(&temporary, path).map_err(|e| error(e.to_string()))
}

/// Start of every temporary name: what a kill leaves behind can be told from everything else.
pub(crate) const TEMPORARY: &str = ".clift-";

pub(crate) fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Gives a finished file its name, with its header in order.
fn publish(temporary: &Path, path: &Path) -> std::io::Result<()> {
    let mut file = File::options().read(true).write(true).open(temporary)?;
    sort_header(&mut file)?;
    // What the store writes is for its owner alone; the umask decides who may read a file that is kept.
    let usual = File::create(temporary.with_extension("usual"))?.metadata()?.permissions();
    file.set_permissions(usual)?;
    file.sync_all()?;
    std::fs::rename(temporary, path)?;
    sync_folder(path)
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

/// Makes the name of a file survive a power cut, where the system lets a folder be synced.
pub(crate) fn sync_folder(path: &Path) -> std::io::Result<()> {
    if cfg!(windows) {
        return Ok(()); // it opens no folders
    }
    match File::open(folder_of(path))?.sync_all() {
        Err(error) if matches!(error.kind(), ErrorKind::InvalidInput | ErrorKind::Unsupported) => Ok(()),
        synced => synced,
    }
}

/// Reads parameters written by [`save`] into a module and says which.
///
/// # Errors
/// [`ModelError::Weights`] when the file cannot be read, a shape differs, or a value is not finite or no 32-bit
/// float.
pub fn load<M: Module>(module: &mut M, path: &Path) -> Result<Loaded, ModelError> {
    let error = |reason: String| ModelError::Weights { action: "reading", reason, path: path.into() };
    if !path.is_file() {
        return Err(error("there is no such file".into()));
    }
    let mut store =
        SafetensorsStore::from_file(path).with_from_adapter(PyTorchToBurnAdapter).validate(false).allow_partial(true);
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
    let missing = result.missing.iter().map(|(name, _)| name_in_file(name)).collect();
    Ok(Loaded { applied: result.applied, missing, unused: result.unused })
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

/// Hash of all parameters of a module: their paths, shapes and values, as 64 hexadecimal digits.
/// Equal weights have equal hashes on every device.
pub fn hash<M: Module>(module: &M) -> String {
    let mut sha = Sha256::new();
    visit(module, |name, shape, data| {
        sha.update(name.as_bytes());
        sha.update(format!("{shape:?}"));
        for value in data.iter::<f32>() {
            sha.update(value.to_le_bytes());
        }
    });
    hex::encode(sha.finalize())
}

/// [`hash`] of a renderer's weights together with what they do not show and drawing depends on: variant and heads.
pub fn renderer_hash(renderer: &Renderer, config: &ModelConfig) -> String {
    let ModelConfig { variant, num_heads, .. } = config;
    hex::encode(Sha256::digest(format!("{variant} {num_heads} {}", hash(renderer))))
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

/// Calls `f` with path, shape and values of every parameter, in the module's order.
fn visit<M: Module>(module: &M, f: impl FnMut(&str, &[usize], &TensorData)) {
    struct Visitor<F> {
        path: Vec<String>,
        f: F,
    }
    impl<F: FnMut(&str, &[usize], &TensorData)> ModuleVisitor for Visitor<F> {
        fn enter_module(&mut self, name: &str, _container: &str) {
            self.path.push(name.into());
        }
        fn exit_module(&mut self, _name: &str, _container: &str) {
            self.path.pop();
        }
        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            (self.f)(&self.path.join("."), &param.val().dims(), &param.val().into_data());
        }
    }
    module.visit(&mut Visitor { path: Vec::new(), f });
}

#[cfg(test)]
mod tests {
    use burn::tensor::Device;

    use super::*;
    use crate::{Clift, ModelConfig};

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
        save(&model(1), &path).expect("writes");
        let mut other = model(2);
        assert_ne!(hash(&other), hash(&model(1)));
        load(&mut other, &path).expect("reads").require_all(&path).expect("the same model");
        assert_eq!(hash(&other), hash(&model(1)));
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
        save(&model(1).encoder, &path).expect("writes");
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
                save(&model(1), &path).expect("writes");
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
        save(&model(1).encoder, &path).expect("writes");
        let missing = load(&mut model(2), &path).expect("nothing fits, nothing breaks").missing;
        assert!(missing.iter().any(|name| name == "renderer.output_norm.weight"), "{missing:?}");
        assert!(!missing.iter().any(|name| name.contains(".gamma") || name.contains(".beta")), "{missing:?}");

        save(&model(1), &path).expect("writes");
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
        save(&model(1), &path).expect("writes");
        let bytes = std::fs::read(&path).expect("reads");
        std::fs::write(&path, &bytes[..bytes.len() / 2]).expect("writes");
        assert!(load(&mut model(1), &path).is_err());
    }
}
