//! The model of a run that is still training.

use std::path::{Path, PathBuf};

use burn::tensor::Device;
use clift_model::{Network, TrainedModel};

use crate::checkpoint::checkpoints::Checkpoints;
use crate::config::config::Config;
use crate::error::TrainError;
use crate::events::Stage;

/// The newest checkpoint of a run whose last stage is not finished.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NewestCheckpoint {
    /// The stage in training.
    pub stage: Stage,
    /// Step of the checkpoint.
    pub step: u64,
    /// Folder of the checkpoint.
    pub path: PathBuf,
}

impl NewestCheckpoint {
    /// Finds the checkpoint; `None` for a finished stage 2, a finished stage 1 without a checkpoint of stage 2, and for a folder
    /// that is not a run.
    pub fn find(run: &Path) -> Result<Option<Self>, TrainError> {
        if !run.join("run.json").is_file() {
            return Ok(None);
        }
        for stage in [Stage::Stage2, Stage::Stage1] {
            let folder = run.join(stage.name());
            let checkpoints = Checkpoints { folder: folder.join("checkpoints"), model: None };
            match checkpoints.newest_step()? {
                _ if folder.join("model.safetensors").exists() => return Ok(None),
                Some(step) => return Ok(Some(Self { stage, step, path: checkpoints.path_of(step) })),
                None => {}
            }
        }
        Ok(None)
    }

    /// Reads the model, with a trained condenser in stage 2.
    pub fn open(&self, config: &Config, run: &Path, device: &Device) -> Result<TrainedModel, TrainError> {
        let initial = Network::new(&config.model, config.seed, device);
        let folder = run.join(self.stage.name()).join("checkpoints");
        let checkpoints = Checkpoints { folder, model: Some(config.model.clone()) };
        let network = checkpoints.load_model(self.step, initial)?;
        Ok(TrainedModel::snapshot(&network, &config.model, self.stage == Stage::Stage2))
    }
}
