//! Exports a model under the names of published checkpoints, for PyTorch, or as a model directory of half the size.

use std::collections::{BTreeMap, HashMap};
use std::path::Path;

use burn::store::PathFilter;
use clift_core::replace_file;
use clift_data::write_state_dict;
use clift_model::{
    CameraEncoding, DeviceName, ModelConfig, ModelPath, Network, PREFIX, PROJECTIONS, TrainedModel, published_tensors,
    save_part_f16,
};
use clift_scene::TokenCodec;
use half::f16;
use safetensors::SafeTensors;
use safetensors::tensor::Dtype;

use crate::config::config::Config;
use crate::error::{TrainError, bad};
use crate::interchange::model_dir::{HostTensor, publish_model_dir, require_absent, to_safetensors, write_file};
use crate::interchange::record::ImportRecord;

/// Format of an exported file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ExportFormat {
    /// `{"state_dict": {..}, "clift": sizes}`, which `torch.load(path, weights_only=True)` reads.
    Pytorch,
    /// The same keys in a safetensors file, the sizes in its metadata.
    Safetensors,
    /// A model directory with this project's keys and weights rounded to f16.
    F16,
}

/// Summary of an export.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Exported {
    /// Number of tensors.
    pub num_tensors: usize,
    /// Number of values.
    pub num_values: usize,
    /// Whether the file contains the condenser.
    pub has_condenser: bool,
}

/// Writes a model's weights in one of the formats. Those of [`ExportFormat::Pytorch`] and [`ExportFormat::Safetensors`] have
/// the keys of published checkpoints, `transformer.` before each, and the token codec beside them.
///
/// # Errors
/// [`TrainError::BadConfig`] if `out` exists, or if there are no published keys: of networks with camera-relative attention, of
/// other architectures than `CLiFT`, and of condensers with `member_share`; [`TrainError::BadFile`] if the weight file does not
/// fit the config, and those of reading and writing.
pub fn export(config: &Config, model: &ModelPath, format: ExportFormat, out: &Path) -> Result<Exported, TrainError> {
    match format {
        ExportFormat::F16 => export_f16(config, model, out),
        ExportFormat::Pytorch => {
            export_published(config, model, out, |tensors| Ok(write_state_dict(out, tensors, &sizes(&config.model))?))
        }
        ExportFormat::Safetensors => export_published(config, model, out, |tensors| {
            let metadata = sizes(&config.model).map(|(name, size)| (name.to_owned(), size.to_string()));
            let bytes = to_safetensors(tensors, HashMap::from(metadata), out)?;
            replace_file(out, &bytes).map_err(TrainError::io("writing the weights", out))
        }),
    }
}

fn export_published(
    config: &Config,
    model: &ModelPath,
    out: &Path,
    write: impl FnOnce(&[HostTensor]) -> Result<(), TrainError>,
) -> Result<Exported, TrainError> {
    let codecs = [&model.weights, out].map(TokenCodec::path_of);
    let codec = codecs[0].exists().then(|| TokenCodec::read(&codecs[0])).transpose()?;
    require_absent(out)?;
    if codec.is_some() && codecs[1].symlink_metadata().is_ok() {
        let fix =
            "the token codec of the model is written there, beside the weights; move the file, or write another -o";
        return Err(bad("token codec", codecs[1].display(), fix));
    }
    config.model.validate()?;
    if !config.model.architecture.supports_export() {
        let fix =
            "the formats are those of CLiFT's checkpoints, which have no names for this network: write --format f16";
        return Err(bad("model.architecture", format!("\"{}\"", config.model.architecture), fix));
    }
    if config.model.camera_encoding != CameraEncoding::Plucker {
        let fix = "published networks have plain attention; only runs with \"plucker\" are exported";
        return Err(bad("model.camera_encoding", config.model.camera_encoding, fix));
    }
    let convolutions = match ImportRecord::read(&model.dir)? {
        Some(imported) => imported.convolutions,
        None => PROJECTIONS.map(String::from).into(),
    };
    let mut ours = read_parameters(&model.weights)?;
    let has_condenser = ours.keys().any(|path| path.starts_with("condenser."));
    if has_condenser && config.model.condenser.member_share {
        let fix = "published condensers add the whole update; only runs with false are exported";
        return Err(bad("model.condenser.member_share", true, fix));
    }
    let bad = |reason: String| TrainError::bad_file("weight file", &model.weights)(reason);
    let mut tensors: Vec<HostTensor> = Vec::new();
    for tensor in published_tensors(&config.model, has_condenser) {
        let mut values = Vec::new();
        for (path, rows) in &tensor.parts {
            let mut shape = tensor.shape.clone();
            shape[0] = rows.len();
            let (found, part) = ours.remove(path).ok_or_else(|| bad(format!("{path} {shape:?} is missing")))?;
            if found != shape {
                return Err(bad(format!("{path} is {found:?}, expected {shape:?}")));
            }
            values.extend(part);
        }
        let mut shape = tensor.shape;
        if tensor.key.strip_suffix(".weight").is_some_and(|layer| convolutions.iter().any(|name| name == layer)) {
            shape.extend([1, 1]);
        }
        tensors.push((format!("{PREFIX}{}", tensor.key), shape, values));
    }
    if let Some(path) = ours.keys().next() {
        return Err(bad(format!("{path} is not a parameter of a {} network", config.model.variant)));
    }
    let exported = Exported {
        num_tensors: tensors.len(),
        num_values: tensors.iter().map(|(_, _, values)| values.len()).sum(),
        has_condenser,
    };
    write(&tensors)?;
    codec.map_or(Ok(()), |codec| codec.write(&codecs[1]))?;
    Ok(exported)
}

/// Writes a model directory with weights in f16. The token codec of the model belongs to the weights before rounding and is
/// not copied.
fn export_f16(config: &Config, model: &ModelPath, folder: &Path) -> Result<Exported, TrainError> {
    require_absent(folder)?;
    let trained = TrainedModel::open_with(model, &config.model, &DeviceName::default().open()?)?;
    let part = if trained.has_condenser { PathFilter::all() } else { Network::stage1_part() };
    let parameters = publish_model_dir(folder, |written| {
        save_part_f16(&trained.network, &part, &written.weights)?;
        for name in ["config.toml", "import.json"] {
            let path = model.dir.join(name);
            if path.exists() {
                let bytes = std::fs::read(&path).map_err(TrainError::io("reading the model directory", &path))?;
                write_file(&written.dir.join(name), &bytes)?;
            }
        }
        read_parameters(&written.weights)
    })?;
    Ok(Exported {
        num_tensors: parameters.len(),
        num_values: parameters.values().map(|(_, values)| values.len()).sum(),
        has_condenser: trained.has_condenser,
    })
}

/// Returns the sizes to store: tensor shapes do not determine the number of heads.
fn sizes(model: &ModelConfig) -> [(&'static str, usize); 6] {
    [
        ("dim", model.dim),
        ("num_heads", model.num_heads),
        ("feed_forward_dim", model.feed_forward_dim),
        ("num_encoder_blocks", model.num_encoder_blocks),
        ("num_renderer_blocks", model.num_renderer_blocks),
        ("patch_size", model.patch_size),
    ]
}

/// Shape and values of parameters, by path.
type Parameters = BTreeMap<String, (Vec<usize>, Vec<f32>)>;

fn read_parameters(path: &Path) -> Result<Parameters, TrainError> {
    let bytes = std::fs::read(path).map_err(TrainError::io("reading the weights", path))?;
    let file = SafeTensors::deserialize(&bytes).map_err(TrainError::bad_file("weight file", path))?;
    let mut found = BTreeMap::new();
    for (name, view) in file.tensors() {
        let data = view.data();
        let values = match view.dtype() {
            Dtype::F32 => data.as_chunks::<4>().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect(),
            Dtype::F16 => data.as_chunks::<2>().0.iter().map(|bytes| f16::from_le_bytes(*bytes).to_f32()).collect(),
            other => {
                let reason = format!("{name} is {other:?}, expected F32 or F16");
                return Err(TrainError::bad_file("weight file", path)(reason));
            }
        };
        found.insert(name, (view.shape().to_vec(), values));
    }
    Ok(found)
}
