//! Weight files: safetensors with PyTorch's names and layout.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Cursor, Read, Seek, SeekFrom, Write};
use std::path::Path;

use burn::module::Module;
use burn::store::burn_pack::Tensor as PackTensor;
use burn::store::{
    ApplyError, BurnToPyTorchAdapter, FloatCastAdapter, ModuleAdapter, ModuleContext, ModuleSnapshot, PathFilter,
    PyTorchToBurnAdapter, SafetensorsStore,
};
use burn::tensor::{DType, TensorData};
use clift_core::{TEMPORARY, first_few, folder_of, publish_file};

use crate::error::ModelError;
use crate::weights::hash::visit;
use crate::weights::network_adapter::NetworkAdapter;

/// The parameters that were read from a file into a module, and those that were not.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct LoadReport {
    /// Parameters read from the file.
    pub applied: Vec<String>,
    /// Parameters of the module that are not in the file; they keep their values.
    pub missing: Vec<String>,
    /// Tensors of the file that are not parameters of the module.
    pub unused: Vec<String>,
}

impl LoadReport {
    /// Checks that file and module have the same parameters.
    pub fn require_all(&self, path: &Path) -> Result<(), ModelError> {
        if self.missing.is_empty() && self.unused.is_empty() {
            return Ok(());
        }
        let reason = format!(
            "the file belongs to another model: {} missing parameters ({}), {} unused tensors ({})",
            self.missing.len(),
            first_few(&self.missing),
            self.unused.len(),
            first_few(&self.unused)
        );
        Err(ModelError::Weights { action: "reading", reason, path: path.into() })
    }
}

/// Writes the parameters of a module with PyTorch's names and layout (linear weights `[outputs, inputs]`). Equal weights
/// are equal files, and a file under its final name is complete.
pub fn save_weights<M: Module>(module: &M, path: &Path) -> Result<(), ModelError> {
    save_part(module, &PathFilter::all(), path)
}

/// Writes the parameters whose paths match `part`, as [`save_weights`].
pub fn save_part<M: Module>(module: &M, part: &PathFilter, path: &Path) -> Result<(), ModelError> {
    write(module, part, BurnToPyTorchAdapter, path)
}

/// Writes parameters as [`save_part`], rounded to f16: half of the bytes.
pub fn save_part_f16<M: Module>(module: &M, part: &PathFilter, path: &Path) -> Result<(), ModelError> {
    let beyond = find(module, |name, data| {
        let beyond = data.iter::<f32>().any(|value| value.abs() >= F16_LIMIT);
        (beyond && part.matches(name)).then(|| format!("{name} contains values beyond the range of f16"))
    });
    if let Some(reason) = beyond {
        return Err(ModelError::Weights { action: "writing", reason, path: path.into() });
    }
    write(module, part, BurnToPyTorchAdapter.chain(FloatCastAdapter::to(DType::F16)), path)
}

/// The least value that is rounded to infinity in f16.
const F16_LIMIT: f32 = 65_520.0;

fn write<M: Module>(
    module: &M,
    part: &PathFilter,
    adapter: impl ModuleAdapter + 'static,
    path: &Path,
) -> Result<(), ModelError> {
    let error = |reason: String| ModelError::Weights { action: "writing", reason, path: path.into() };
    // The store's own temporary files survive a kill. In a temporary folder, they are deleted on errors, and leftovers are
    // recognised by its name.
    let folder = tempfile::Builder::new().prefix(TEMPORARY).tempdir_in(folder_of(path));
    let folder = folder.map_err(|e| error(e.to_string()))?;
    let temporary = folder.path().join("model.safetensors");
    let mut store = SafetensorsStore::from_file(&temporary)
        .with_to_adapter(adapter)
        .filter(part.clone())
        .overwrite(true)
        .metadata("format", "clift-1");
    module.save_into(&mut store).map_err(|e| error(e.to_string()))?;
    let sorted = File::options().read(true).write(true).open(&temporary).and_then(|mut file| sort_header(&mut file));
    sorted.and_then(|()| publish_file(&temporary, path)).map_err(|e| error(e.to_string()))
}

/// Rewrites a safetensors header with sorted keys, which Burn's store writes in random order. The bytes of the tensors stay
/// in place.
fn sort_header(file: &mut (impl Read + Write + Seek)) -> std::io::Result<()> {
    let mut length = [0; 8];
    file.read_exact(&mut length)?;
    let length = u64::from_le_bytes(length);
    let mut header = vec![0; usize::try_from(length).map_err(std::io::Error::other)?];
    file.read_exact(&mut header)?;
    let entries: BTreeMap<String, BTreeMap<String, serde_json::Value>> = serde_json::from_slice(&header)?;
    let mut sorted = serde_json::to_vec(&entries)?;
    if sorted.len() > header.len() {
        return Err(std::io::Error::other("the header with sorted keys is longer than the header"));
    }
    sorted.resize(header.len(), b' ');
    file.seek(SeekFrom::Start(8))?;
    file.write_all(&sorted)
}

/// Sorts the keys of the header of a safetensors file in memory.
pub fn sorted_header(mut bytes: Vec<u8>) -> std::io::Result<Vec<u8>> {
    sort_header(&mut Cursor::new(&mut bytes[..]))?;
    Ok(bytes)
}

/// Reads the parameters whose paths match `part`, as [`save_weights`], [`save_part`] and [`save_part_f16`] write them, into
/// a module as f32. Other tensors of the file are unused.
pub fn load_part<M: Module>(module: &mut M, part: &PathFilter, path: &Path) -> Result<LoadReport, ModelError> {
    load_adapted(module, part, path, NetworkAdapter::default())
}

/// Reads parameters as [`load_part`], those between pixels and tokens through an adapter.
pub fn load_adapted<M: Module>(
    module: &mut M,
    part: &PathFilter,
    path: &Path,
    adapter: NetworkAdapter,
) -> Result<LoadReport, ModelError> {
    let store = SafetensorsStore::from_file(path).filter(part.clone());
    read(module, store.with_from_adapter(PyTorchToBurnAdapter.chain(Widen).chain(adapter)), part, path)
}

/// Reads one module of a larger one from its file, such as the `renderer` of a whole model.
pub fn load_module<M: Module>(module: &mut M, name: &str, path: &Path) -> Result<LoadReport, ModelError> {
    let store = SafetensorsStore::from_file(path).with_key_remapping(format!("^{name}\\."), "");
    read(module, store.with_from_adapter(PyTorchToBurnAdapter.chain(Widen)), &PathFilter::all(), path)
}

fn read<M: Module>(
    module: &mut M,
    store: SafetensorsStore,
    part: &PathFilter,
    path: &Path,
) -> Result<LoadReport, ModelError> {
    let error = |reason: String| ModelError::Weights { action: "reading", reason, path: path.into() };
    if !path.is_file() {
        return Err(error("no such file".into()));
    }
    let mut store = store.validate(false).allow_partial(true);
    let result = module.load_from(&mut store).map_err(|e| error(e.to_string()))?;
    if let Some(first) = result.errors.first() {
        return Err(error(describe(first)));
    }
    let problem = find(module, |name, data| match data.dtype() {
        DType::F32 if data.iter::<f32>().all(f32::is_finite) => None,
        DType::F32 => Some(format!("{name} contains values that are not finite")),
        other => Some(format!("{name} is {other:?}, expected F32")),
    });
    if let Some(problem) = problem {
        return Err(error(problem));
    }
    // Burn also reports absent parameters that do not match the filter.
    let missing = result.missing.iter().filter(|(name, _)| part.matches(name));
    let missing = missing.map(|(name, _)| name_in_file(name)).collect();
    let mut unused = result.unused;
    unused.extend(result.skipped.iter().map(|name| name_in_file(name)));
    unused.sort();
    Ok(LoadReport { applied: result.applied, missing, unused })
}

/// Converts f16 and bf16 to f32, which is exact; other types keep theirs.
#[derive(Clone, Debug)]
struct Widen;

impl ModuleAdapter for Widen {
    fn adapt(&self, tensor: PackTensor, context: ModuleContext<'_>) -> PackTensor {
        match tensor.dtype {
            DType::F16 | DType::BF16 => FloatCastAdapter::to(DType::F32).adapt(tensor, context),
            _ => tensor,
        }
    }

    fn clone_box(&self) -> Box<dyn ModuleAdapter> {
        Box::new(self.clone())
    }
}

/// Returns the name of a parameter in a file. Burn names the parameters of norms differently.
fn name_in_file(path: &str) -> String {
    for (here, there) in [(".gamma", ".weight"), (".beta", ".bias")] {
        if let Some(module) = path.strip_suffix(here) {
            return format!("{module}{there}");
        }
    }
    path.to_owned()
}

/// Describes an error with the shapes of files. All matrices are weights of linear layers, which Burn keeps as
/// `[inputs, outputs]`.
fn describe(error: &ApplyError) -> String {
    let ApplyError::ShapeMismatch { path, expected, found } = error else { return error.to_string() };
    let [expected, found] = [expected, found].map(|shape| {
        let mut sizes = shape.to_vec();
        if sizes.len() == 2 {
            sizes.reverse();
        }
        sizes
    });
    format!("{} is {found:?}, expected {expected:?}", name_in_file(path))
}

/// Returns path and type of the first parameter that is no 32-bit float.
pub fn first_not_f32<M: Module>(module: &M) -> Option<(String, DType)> {
    find(module, |name, data| (data.dtype() != DType::F32).then(|| (name.to_owned(), data.dtype())))
}

/// Returns the first result of `f`, called with path and values of every parameter.
fn find<M: Module, T>(module: &M, f: impl Fn(&str, &TensorData) -> Option<T>) -> Option<T> {
    let mut found = None;
    visit(module, |name, _, data| {
        if found.is_none() {
            found = f(name, data);
        }
    });
    found
}

#[cfg(test)]
mod tests {
    use burn::tensor::Device;

    use super::*;
    use crate::network::architecture::CliftVariant;
    use crate::network::model::Network;
    use crate::testing::small_config;
    use crate::weights::hash::weights_hash;

    fn model(seed: u64) -> Network {
        Network::new(&small_config(CliftVariant::Paper), seed, &Device::flex())
    }

    fn load(module: &mut Network, path: &Path) -> Result<LoadReport, ModelError> {
        load_part(module, &PathFilter::all(), path)
    }

    #[test]
    fn equal_weights_are_equal_files_that_read_back_exactly() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let paths = [0, 1, 2, 3].map(|i| folder.path().join(format!("{i}.safetensors")));
        let files = paths.each_ref().map(|path| {
            save_weights(&model(1), path).expect("writes");
            std::fs::read(path).expect("reads")
        });
        // Three keys in random order are equal in four files once in 216 times.
        assert!(files.iter().all(|bytes| *bytes == files[0]));
        let (_, header) = safetensors::SafeTensors::read_metadata(&files[0]).expect("valid");
        let metadata = header.metadata().as_ref().expect("there");
        assert!(metadata.len() >= 2 && metadata["format"] == "clift-1", "{metadata:?}");

        let mut other = model(2);
        assert_ne!(weights_hash(&other), weights_hash(&model(1)));
        load(&mut other, &paths[0]).expect("reads").require_all(&paths[0]).expect("the same model");
        assert_eq!(weights_hash(&other), weights_hash(&model(1)));
        assert_eq!(std::fs::read_dir(folder.path()).expect("a folder").count(), 4, "no temporary file is left");
        let plain = folder.path().join("plain");
        File::create(&plain).expect("writes");
        let permissions = |path: &Path| std::fs::metadata(path).expect("there").permissions();
        assert_eq!(permissions(&paths[0]), permissions(&plain));
    }

    #[test]
    fn errors_have_the_names_and_shapes_of_the_file() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("model.safetensors");
        assert!(load(&mut model(1), &path).unwrap_err().to_string().contains("no such file"));
        save_weights(&model(1).encoder, &path).expect("writes");
        let loaded = load(&mut model(2), &path).expect("a file without a matching name is not an error");
        let message = loaded.require_all(&path).unwrap_err().to_string();
        assert!(message.contains(" missing parameters (condenser.blocks.0"), "{message}");
        let missing = loaded.missing;
        assert!(missing.iter().any(|name| name == "renderer.output_norm.weight"), "{missing:?}");
        assert!(!missing.iter().any(|name| name.contains(".gamma") || name.contains(".beta")), "{missing:?}");

        save_weights(&model(1), &path).expect("writes");
        let mut config = small_config(CliftVariant::Paper);
        config.feed_forward_dim = 20;
        let mut narrow = Network::new(&config, 0, &Device::flex());
        let message = load(&mut narrow, &path).unwrap_err().to_string();
        let shapes =
            ["bias is [22], expected [20]", "is [22, 15], expected [20, 15]", "is [15, 22], expected [15, 20]"];
        assert!(shapes.iter().any(|shapes| message.contains(shapes)), "{message}");

        let bytes = std::fs::read(&path).expect("reads");
        std::fs::write(&path, &bytes[..bytes.len() / 2]).expect("writes");
        assert!(load(&mut model(1), &path).is_err(), "a truncated file");
    }
}
