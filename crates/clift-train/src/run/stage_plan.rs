//! Settings, batches and folder of a stage, the same for both stages.

use std::path::PathBuf;
use std::sync::Arc;

use burn::module::{Module, ParamGroup};
use burn::optim::lr_scheduler::module_lr_scheduler::{ModuleLearningRate, ModuleLrScheduler};
use burn::tensor::Device;
use clift_data::Prefetcher;
use clift_model::{Clift, Part};

use crate::checkpoint::checkpoints::Checkpoints;
use crate::config::config::Config;
use crate::error::TrainError;
use crate::events::Stage;
use crate::stage::settings::StageSettings;
use crate::step::batch::StageBatch;

/// Makes the batch of a step; called from several threads.
pub type MakeBatch = dyn Fn(u64) -> Result<StageBatch, TrainError> + Send + Sync;

/// A stage to train.
pub struct StagePlan<'a> {
    /// Stage, steps, optimizer and trained networks.
    pub settings: StageSettings<'a>,
    /// Makes the batches.
    pub batches: Arc<MakeBatch>,
    /// Config of the run.
    pub config: &'a Config,
    /// Folder of the stage inside the run.
    pub folder: PathBuf,
    /// The autodiff device.
    pub device: Device,
}

impl StagePlan<'_> {
    /// Starts to make the batches of the steps after `step`.
    pub(crate) fn prefetch(&self, step: u64) -> Prefetcher<StageBatch, TrainError> {
        let (data, make) = (&self.config.data, self.batches.clone());
        Prefetcher::new(move |step| make(step), step, self.settings.steps, data.num_threads, data.num_prefetch)
    }

    /// Opens the checkpoints of the stage.
    pub(crate) fn checkpoints(&self) -> Checkpoints {
        let checkpoints = Checkpoints::new(self.folder.join("checkpoints"), self.config.checkpoint.clone());
        checkpoints.with_model(self.config.model.clone())
    }

    /// Makes a model whose parameters a checkpoint will replace.
    pub(crate) fn blank_model(&self) -> Clift {
        Clift::new(&self.config.model, self.config.seed, &self.device)
    }

    /// Returns the learning rates of a step: `lr`, and for the renderer `lr` times its factor.
    pub(crate) fn learning_rate(&self, lr: f64) -> ModuleLearningRate {
        let renderer = ParamGroup::from_predicate("renderer");
        ModuleLrScheduler::new(lr).with_group(renderer, constant(lr * self.settings.renderer_lr_factor)).step()
    }
}

/// Freezes the networks that the stage does not train: their parameters get no gradient and no weight decay.
pub fn freeze(stage: Stage, mut model: Clift) -> Clift {
    let trained = stage.trained();
    if !trained.contains(&Part::Encoder) {
        model.encoder = model.encoder.no_grad();
    }
    if !trained.contains(&Part::Condenser) {
        model.condenser = model.condenser.no_grad();
    }
    model
}

fn constant(lr: f64) -> burn::optim::lr_scheduler::DynLrScheduler {
    lr.into()
}
