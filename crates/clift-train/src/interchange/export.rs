//! Writes a model directory of half the size: weights rounded to f16.

use std::path::Path;

use burn::module::Module;
use burn::store::PathFilter;
use clift_core::replace_file;
use clift_model::{DeviceName, ModelPath, Network, TrainedModel, save_part_f16};

use crate::config::config::Config;
use crate::error::TrainError;
use crate::interchange::model_dir::publish_model_dir;

/// Writes the model directory `folder` with the weights of a model in f16; returns the number of values. The token codec of the
/// model belongs to the weights before rounding and is not copied.
///
/// # Errors
/// [`TrainError::BadConfig`] if `folder` exists, and those of reading and writing.
pub fn export_f16(config: &Config, model: &ModelPath, folder: &Path) -> Result<usize, TrainError> {
    let trained = TrainedModel::open_with(model, &config.model, &DeviceName::default().open()?)?;
    let part = if trained.has_condenser { PathFilter::all() } else { Network::stage1_part() };
    publish_model_dir(folder, |written| {
        save_part_f16(&trained.network, &part, &written.weights)?;
        let (from, to) = (model.dir.join("config.toml"), written.dir.join("config.toml"));
        let text = std::fs::read(&from).map_err(TrainError::io("reading the config of the model", &from))?;
        replace_file(&to, &text).map_err(TrainError::io("writing the model directory", &to))
    })?;
    let condenser = if trained.has_condenser { 0 } else { trained.network.condenser.num_params() };
    Ok(trained.network.num_params() - condenser)
}
