//! Settings, batches and folder of a stage, the same for both stages.

use std::path::PathBuf;
use std::sync::Arc;

use burn::module::ParamGroup;
use burn::optim::lr_scheduler::DynLrScheduler;
use burn::optim::lr_scheduler::module_lr_scheduler::{ModuleLearningRate, ModuleLrScheduler};
use burn::tensor::Device;
use clift_data::Prefetcher;

use crate::config::config::Config;
use crate::distributed::parts::BatchParts;
use crate::distributed::ranks::Ranks;
use crate::error::TrainError;
use crate::stage::settings::StageSettings;
use crate::step::batch::StageBatch;

/// Makes the batch of a step; called from several threads.
pub type MakeBatch = dyn Fn(u64) -> Result<StageBatch, TrainError> + Send + Sync;

/// A stage to train.
pub struct StagePlan<'a> {
    /// Stage, steps, optimizer and learning rates.
    pub settings: StageSettings<'a>,
    pub batches: Arc<MakeBatch>,
    pub config: &'a Config,
    /// Folder of the stage inside the run.
    pub folder: PathBuf,
    /// The autodiff device.
    pub device: Device,
    pub ranks: &'a Ranks,
    /// Division of the batch of a step.
    pub parts: BatchParts,
}

/// Most threads that prepare batches where the config sets no number.
const MAX_THREADS: usize = 16;

impl StagePlan<'_> {
    /// Starts to make the batches of the steps after `step`.
    pub(crate) fn prefetch(&self, step: u64) -> Prefetcher<StageBatch, TrainError> {
        let (data, make) = (&self.config.data, self.batches.clone());
        // A CPU trains on all threads.
        let unset = if self.config.device.is_cpu() { 1 } else { rayon::current_num_threads().min(MAX_THREADS) };
        let threads = data.num_threads.unwrap_or(unset);
        Prefetcher::new(move |step| make(step), step, self.settings.steps, threads, data.num_prefetch.max(threads))
    }

    /// Returns the learning rates of a step: `lr`, and for the renderer `lr` times its factor.
    pub(crate) fn learning_rate(&self, lr: f64) -> ModuleLearningRate {
        let renderer = DynLrScheduler::from(lr * self.settings.renderer_lr_factor);
        ModuleLrScheduler::new(lr).with_group(ParamGroup::from_predicate("renderer"), renderer).step()
    }
}
