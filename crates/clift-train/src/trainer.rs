//! What a stage trains and from where, the same for both stages.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

use burn::module::{Module, ParamGroup};
use burn::optim::lr_scheduler::module_lr_scheduler::{ModuleLearningRate, ModuleLrScheduler};
use burn::tensor::Device;
use clift_data::Prefetcher;
use clift_data::files::make_folder;
use clift_model::Clift;

use crate::TrainError;
use crate::checkpoint::Checkpoints;
use crate::config::{Config, OptimizerConfig};
use crate::events::{Event, Sink, Stage};
use crate::loss::Loss;
use crate::loss_scale::LossScale;
use crate::optim::adamw;
use crate::sinks::RunLog;
use crate::step::{Learner, StageBatch};
use crate::training::Training;
use crate::validation::Validation;

/// Makes the batch of a step, in any thread.
pub type MakeBatch = dyn Fn(u64) -> Result<StageBatch, TrainError> + Send + Sync;

/// What one stage trains, on what, for how long.
pub struct StagePlan<'a> {
    /// Which stage.
    pub stage: Stage,
    /// Optimiser updates.
    pub num_steps: u64,
    /// Parts a batch is worked off in.
    pub accumulate: usize,
    /// The update rule.
    pub optimizer: &'a OptimizerConfig,
    /// Learning rate of the renderer over that of the rest.
    pub renderer_lr_factor: f64,
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
    /// Trains from where the stage stands and returns the model when all steps are done. `start` gives
    /// the model to start from, and is called only where there is no checkpoint.
    ///
    /// # Errors
    /// [`TrainError::Interrupted`] after `stop` was set and the state saved, [`TrainError::Diverged`]
    /// after too many bad steps, [`TrainError::Stopped`] with whatever data, model or disk give.
    pub fn train(
        &self,
        start: impl FnOnce(&mut dyn Sink) -> Result<Clift, TrainError>,
        validation: &Validation,
        stop: &AtomicBool,
        sink: &mut dyn Sink,
    ) -> Result<Clift, TrainError> {
        let started = Instant::now();
        let checkpoints = self.checkpoints();
        let model = if checkpoints.newest()?.is_some() { self.blank_model() } else { start(sink)? };
        let optimizer = adamw(self.optimizer);
        let loss = Loss::load(&self.config.loss, &self.device)?;
        if let Some(sha256) = loss.sha256() {
            sink.event(&Event::Message(format!("perceptual loss: weights with SHA-256 {sha256}")));
        }
        let (device, recompute) = (self.device.clone(), self.config.recompute);
        let loss_scale = LossScale::of(self.config.precision);
        let mut learner = Learner { model, optimizer, device, loss, recompute, loss_scale };
        let progress = checkpoints.resume(&mut learner)?.unwrap_or_default();
        learner.model = freeze(self.stage, learner.model);
        make_folder(&self.folder).map_err(TrainError::io("making a folder", &self.folder))?;
        let run_dir = self.folder.parent().unwrap_or(&self.folder);
        let mut log = RunLog::open(run_dir, self.stage, progress.step, sink)?;
        log.event(&Event::StageStarted { stage: self.stage, done: progress.step, num_steps: self.num_steps });

        let mut training = Training::new(self, checkpoints, progress, validation, stop, log);
        let model = training.run(learner).map_err(|error| training.name_checkpoint(error))?;
        training.log.event(&Event::StageFinished { stage: self.stage, elapsed_s: started.elapsed().as_secs_f64() });
        Ok(model)
    }

    /// The batches of the steps after `step`.
    pub(crate) fn prefetch(&self, step: u64) -> Prefetcher<StageBatch, TrainError> {
        let (data, make) = (&self.config.data, self.batches.clone());
        Prefetcher::new(move |step| make(step), step, self.num_steps, data.num_threads, data.num_prefetch)
    }

    /// The checkpoints of the stage.
    pub(crate) fn checkpoints(&self) -> Checkpoints {
        let checkpoints = Checkpoints::new(self.folder.join("checkpoints"), self.config.checkpoint.clone());
        checkpoints.of(self.config.model.clone())
    }

    /// A model whose parameters a checkpoint is about to replace.
    fn blank_model(&self) -> Clift {
        Clift::new(&self.config.model, self.config.seed, &self.device)
    }

    /// The rates of a step, of which `lr` is that of the first parameter group.
    pub(crate) fn learning_rate(&self, lr: f64) -> ModuleLearningRate {
        let renderer = ParamGroup::from_predicate("renderer");
        ModuleLrScheduler::new(lr).with_group(renderer, constant(lr * self.renderer_lr_factor)).step()
    }
}

/// Parameters the stage does not train get no gradient and no decay.
pub(crate) fn freeze(stage: Stage, mut model: Clift) -> Clift {
    match stage {
        Stage::Stage2 => model.encoder = model.encoder.no_grad(),
        _ => model.condenser = model.condenser.no_grad(),
    }
    model
}

fn constant(lr: f64) -> burn::optim::lr_scheduler::DynLrScheduler {
    lr.into()
}
