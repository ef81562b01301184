//! A model directory: `model.safetensors`, `config.toml` with the network and its evaluation settings, and `import.json`.

use std::collections::HashMap;
use std::path::Path;

use clift_core::{PoseRotation, PoseScale, TEMPORARY, folder_of, publish_folder, replace_file};
use clift_data::SourceKind;
use clift_model::{CliftVariant, ModelConfig, ModelPath, TrainedModel, sorted_header};
use safetensors::SafeTensorError;
use safetensors::tensor::{Dtype, TensorView};
use serde::Serialize;

use crate::config::config::Config;
use crate::error::{TrainError, bad};

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

/// Writes the model directory of an import under a temporary name, opens the model to check it, and renames the directory.
/// Removes all files on errors.
pub(crate) fn write_model_dir(
    folder: &Path,
    config: &Config,
    parameters: &[HostTensor],
    imported: &impl Serialize,
) -> Result<(), TrainError> {
    publish_model_dir(folder, |written| {
        let write = |path: &Path, bytes: &[u8]| replace_file(path, bytes).map_err(TrainError::io(WRITING, path));
        let bytes = to_safetensors(parameters).map_err(TrainError::bad_file("weight file", folder))?;
        write(&written.weights, &bytes)?;
        drop(bytes);
        let config_text = toml::to_string_pretty(config).map_err(TrainError::bad_file("config", folder))?;
        write(&written.dir.join("config.toml"), config_text.as_bytes())?;
        let import_text = serde_json::to_vec_pretty(imported).map_err(TrainError::bad_file("import.json", folder))?;
        write(&written.dir.join("import.json"), &import_text)?;
        TrainedModel::open_with(written, &config.model, &config.device.open()?)?;
        Ok(())
    })
}

const WRITING: &str = "writing the model directory";

/// Makes a directory under a temporary name, has `fill` write its files, and renames it. Removes it on errors.
pub(crate) fn publish_model_dir(
    folder: &Path,
    fill: impl FnOnce(&ModelPath) -> Result<(), TrainError>,
) -> Result<(), TrainError> {
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
    fill(&ModelPath { dir: temporary.path().into(), weights: temporary.path().join("model.safetensors") })?;
    require_absent(folder)?;
    publish_folder(temporary.path(), folder).map_err(TrainError::io(WRITING, folder))?;
    let _ = temporary.keep(); // the directory was renamed
    Ok(())
}

fn to_safetensors(tensors: &[HostTensor]) -> std::io::Result<Vec<u8>> {
    let to_bytes = |values: &[f32]| values.iter().flat_map(|value| value.to_le_bytes()).collect();
    let bytes: Vec<Vec<u8>> = tensors.iter().map(|(_, _, values)| to_bytes(values)).collect();
    let views = tensors
        .iter()
        .zip(&bytes)
        .map(|((name, shape, _), bytes)| Ok((name, TensorView::new(Dtype::F32, shape.clone(), bytes)?)))
        .collect::<Result<Vec<_>, SafeTensorError>>();
    let metadata = HashMap::from([("format".to_owned(), "clift-1".to_owned())]);
    let file = views.and_then(|views| safetensors::serialize(views, Some(metadata))).map_err(std::io::Error::other)?;
    // Equal weights give equal files.
    sorted_header(file)
}
