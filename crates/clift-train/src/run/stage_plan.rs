//! What a stage trains and from where, the same for both stages.

use std::path::PathBuf;
use std::sync::Arc;

use burn::module::{Module, ParamGroup};
use burn::optim::lr_scheduler::module_lr_scheduler::{ModuleLearningRate, ModuleLrScheduler};
use burn::tensor::Device;
use clift_data::Prefetcher;
use clift_model::Clift;

use crate::checkpoint::checkpoints::Checkpoints;
use crate::config::config::Config;
use crate::error::TrainError;
use crate::events::Stage;
use crate::stage::settings::{StageSettings, TapeSegment};
use crate::step::batch::StageBatch;

/// Makes the batch of a step, in any thread.
pub type MakeBatch = dyn Fn(u64) -> Result<StageBatch, TrainError> + Send + Sync;

/// What one stage trains, on what, for how long.
pub struct StagePlan<'a> {
    /// Stage, steps, update rule and trained parts.
    pub settings: StageSettings<'a>,
    /// The batches.
    pub batches: Arc<MakeBatch>,
    /// Loader, checkpoints and validations.
    pub config: &'a Config,
    /// Folder of the stage inside the run.
    pub folder: PathBuf,
    /// Where tensors live, with autodiff.
    pub device: Device,
}

impl StagePlan<'_> {
    /// The batches of the steps after `step`.
    pub(crate) fn prefetch(&self, step: u64) -> Prefetcher<StageBatch, TrainError> {
        let (data, make) = (&self.config.data, self.batches.clone());
        Prefetcher::new(move |step| make(step), step, self.settings.steps, data.num_threads, data.num_prefetch)
    }

    /// The checkpoints of the stage.
    pub(crate) fn checkpoints(&self) -> Checkpoints {
        let checkpoints = Checkpoints::new(self.folder.join("checkpoints"), self.config.checkpoint.clone());
        checkpoints.of(self.config.model.clone())
    }

    /// A model whose parameters a checkpoint is about to replace.
    pub(crate) fn blank_model(&self) -> Clift {
        Clift::new(&self.config.model, self.config.seed, &self.device)
    }

    /// The rates of a step, of which `lr` is that of the first parameter group.
    pub(crate) fn learning_rate(&self, lr: f64) -> ModuleLearningRate {
        let renderer = ParamGroup::from_predicate("renderer");
        ModuleLrScheduler::new(lr).with_group(renderer, constant(lr * self.settings.renderer_lr_factor)).step()
    }
}

/// Parameters of parts that the stage does not train get no gradient and no decay.
pub fn freeze(stage: Stage, mut model: Clift) -> Clift {
    let trained = stage.trained();
    if !trained.contains(&TapeSegment::Encoder) {
        model.encoder = model.encoder.no_grad();
    }
    if !trained.contains(&TapeSegment::Condenser) {
        model.condenser = model.condenser.no_grad();
    }
    model
}

fn constant(lr: f64) -> burn::optim::lr_scheduler::DynLrScheduler {
    lr.into()
}
