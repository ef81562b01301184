//! A model directory: `model.safetensors`, `config.toml` with the network and its evaluation settings, and `import.json`.

use std::collections::HashMap;
use std::path::Path;
use std::sync::atomic::AtomicBool;

use clift_core::{PoseRotation, PoseScale, TEMPORARY, folder_of, publish_folder, replace_file};
use clift_data::SourceKind;
use clift_model::{CliftVariant, ModelConfig, ModelPath, TrainedModel, sorted_header};
use clift_scene::TokenCodec;
use safetensors::tensor::{Dtype, TensorView};

use crate::config::config::Config;
use crate::error::{TrainError, bad};
use crate::interchange::record::{ImportRecord, check_stop};

/// Name, shape and row-major values of a tensor in PyTorch's layout, as [`clift_data::write_state_dict`] takes it.
pub type HostTensor = (String, Vec<usize>, Vec<f32>);

/// Returns the settings with which the released code evaluates a published network.
pub fn evaluation_config(model: ModelConfig, folder: &Path) -> Config {
    // Run directory of `clift train` with this config.
    let run_dir = Path::new("runs").join(folder.file_name().unwrap_or("imported".as_ref()));
    let mut config = Config { run_dir, ..Config::default() };
    let data = &mut config.data;
    data.source = SourceKind::Auto;
    (data.views.min_context, data.views.max_context) = (4, 4);
    match model.variant {
        CliftVariant::Paper => {}
        CliftVariant::ReleasedRe10k => {
            (data.pose_rotation, data.pose_scale) = (PoseRotation::Quaternion, PoseScale::All);
        }
        CliftVariant::ReleasedDl3dv => {
            (data.width, data.height) = (448, 256);
            (data.pose_rotation, data.pose_scale) = (PoseRotation::Axes, PoseScale::Context);
            data.views.max_context = 6;
        }
    }
    config.model = model;
    config
}

/// Refuses an output path that exists, also as a broken link.
pub fn require_absent(path: &Path) -> Result<(), TrainError> {
    if path.symlink_metadata().is_err() {
        return Ok(());
    }
    Err(bad("-o", path.display(), "the path exists and is not overwritten; write another one"))
}

/// Writes the model directory of an import and opens the model to check it. Removes all files if `stop` is set before.
pub(crate) fn write_model_dir(
    folder: &Path,
    config: &Config,
    parameters: &[HostTensor],
    (imported, file): (&ImportRecord, &Path),
    stop: &AtomicBool,
) -> Result<(), TrainError> {
    publish_model_dir(folder, |written| {
        let bytes = to_safetensors(parameters, HashMap::new(), folder)?;
        check_stop(stop)?;
        write_file(&written.weights, &bytes)?;
        drop(bytes);
        check_stop(stop)?;
        let config_text = toml::to_string_pretty(config).map_err(TrainError::bad_file("config", folder))?;
        write_file(&written.dir.join("config.toml"), config_text.as_bytes())?;
        let import_text = serde_json::to_vec_pretty(imported).map_err(TrainError::bad_file("import.json", folder))?;
        write_file(&written.dir.join("import.json"), &import_text)?;
        let model = TrainedModel::open_with(written, &config.model, &config.device.open()?)?;
        if let Some(codec) = TokenCodec::beside(file, &model)? {
            codec.write(&TokenCodec::path_of(&written.weights))?;
        }
        check_stop(stop)
    })
}

const WRITING: &str = "writing the model directory";

/// Makes a directory under a temporary name, has `fill` write its files, and renames it. Removes it on errors. Returns the
/// result of `fill`.
pub(crate) fn publish_model_dir<T>(
    folder: &Path,
    fill: impl FnOnce(&ModelPath) -> Result<T, TrainError>,
) -> Result<T, TrainError> {
    if folder.file_name().is_none() {
        return Err(bad("-o", folder.display(), "write the name of a directory"));
    }
    let above = folder_of(folder);
    let mut builder = tempfile::Builder::new();
    builder.prefix(TEMPORARY);
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o777));
    // Removed on drop.
    let temporary = std::fs::create_dir_all(above).and_then(|()| builder.tempdir_in(above));
    let temporary = temporary.map_err(TrainError::io(WRITING, above))?;
    let filled =
        fill(&ModelPath { dir: temporary.path().into(), weights: temporary.path().join("model.safetensors") })?;
    require_absent(folder)?;
    publish_folder(temporary.path(), folder).map_err(TrainError::io(WRITING, folder))?;
    let _ = temporary.keep(); // the directory was renamed
    Ok(filled)
}

pub(crate) fn write_file(path: &Path, bytes: &[u8]) -> Result<(), TrainError> {
    replace_file(path, bytes).map_err(TrainError::io(WRITING, path))
}

pub(crate) fn to_safetensors(
    tensors: &[HostTensor],
    mut metadata: HashMap<String, String>,
    path: &Path,
) -> Result<Vec<u8>, TrainError> {
    let bad = |error: safetensors::SafeTensorError| TrainError::bad_file("weight file", path)(error);
    let to_bytes = |values: &[f32]| values.iter().flat_map(|value| value.to_le_bytes()).collect();
    let bytes: Vec<Vec<u8>> = tensors.iter().map(|(_, _, values)| to_bytes(values)).collect();
    let views = tensors
        .iter()
        .zip(&bytes)
        .map(|((name, shape, _), bytes)| Ok((name, TensorView::new(Dtype::F32, shape.clone(), bytes)?)))
        .collect::<Result<Vec<_>, _>>();
    metadata.insert("format".into(), "clift-1".into());
    let file = safetensors::serialize(views.map_err(bad)?, Some(metadata)).map_err(bad)?;
    // Equal weights give equal files.
    sorted_header(file).map_err(TrainError::bad_file("weight file", path))
}
