//! Initial weights of stage 1 from another model.

use std::path::Path;

use clift_model::{Clift, ModelConfig, ModelPath, check_heads, load_part, refuse_checkpoint};

use crate::error::TrainError;
use crate::events::{Event, Sink};

/// Loads the weights of stage 1 of another run, of a model directory or of a weight file, and reports which parameters
/// were loaded.
pub(crate) fn init_from(
    model: &mut Clift,
    config: &ModelConfig,
    from: &Path,
    sink: &mut dyn Sink,
) -> Result<(), TrainError> {
    let in_folder = ["stage1/model.safetensors", "model.safetensors"].map(|file| from.join(file));
    let [run, _] = &in_folder;
    let path = if from.is_dir() { in_folder.iter().find(|file| file.exists()).unwrap_or(run) } else { from };
    refuse_checkpoint(path)?;
    // The number of heads of a weight file without a config is unknown.
    if let Ok(found) = ModelPath::find(path) {
        check_heads(config, &found.dir)?;
    }
    let loaded = load_part(model, &Clift::stage1_part(), path)?;
    if loaded.applied.is_empty() {
        let reason = "no tensor of the file fits this model".to_owned();
        return Err(TrainError::bad_file("weight file for stage1.init_from", path)(reason));
    }
    let list = |names: &[String]| if names.is_empty() { "none".into() } else { names.join(", ") };
    sink.event(&Event::Message(format!(
        "loaded {} parameters from {}; initialized, not in the file: {}; unused in the file: {}",
        loaded.applied.len(),
        path.display(),
        list(&loaded.missing),
        list(&loaded.unused)
    )));
    Ok(())
}
