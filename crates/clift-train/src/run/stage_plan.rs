//! Trains one stage, new or resumed, to its last step; the same for both stages.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

use burn::module::ParamGroup;
use burn::optim::lr_scheduler::DynLrScheduler;
use burn::optim::lr_scheduler::module_lr_scheduler::{ModuleLearningRate, ModuleLrScheduler};
use burn::tensor::Device;
use clift_data::{Prefetcher, make_folder};
use clift_model::Clift;

use crate::checkpoint::checkpoints::Checkpoints;
use crate::config::config::Config;
use crate::error::TrainError;
use crate::events::{Event, Sink};
use crate::run::logs::RunLog;
use crate::run::train_loop::TrainLoop;
use crate::run::validation::Validation;
use crate::stage::settings::{StageSettings, freeze};
use crate::step::batch::StageBatch;
use crate::step::loss::Loss;
use crate::step::loss_scale::LossScale;
use crate::step::train_state::TrainState;

/// Makes the batch of a step; called from several threads.
pub type MakeBatch = dyn Fn(u64) -> Result<StageBatch, TrainError> + Send + Sync;

/// A stage to train.
pub struct StagePlan<'a> {
    /// Stage, steps, optimizer and learning rates.
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
    /// Trains the remaining steps and returns the model. `start` makes the initial model if there is no checkpoint.
    ///
    /// # Errors
    /// [`TrainError::Interrupted`] after `stop` was set and the state saved, [`TrainError::Diverged`] after too many skipped
    /// steps, [`TrainError::Stopped`] with an error of data, model or disk.
    pub fn train(
        &self,
        start: impl FnOnce(&mut dyn Sink) -> Result<Clift, TrainError>,
        validation: &Validation,
        stop: &AtomicBool,
        sink: &mut dyn Sink,
    ) -> Result<Clift, TrainError> {
        let started = Instant::now();
        let Self { settings, config, folder, device, .. } = self;
        let StageSettings { stage, steps: num_steps, optimizer, .. } = *settings;
        let checkpoints = Checkpoints::new(folder.join("checkpoints"), config.checkpoint.clone());
        let checkpoints = checkpoints.with_model(config.model.clone());
        let model = match checkpoints.newest()? {
            // The checkpoint replaces all parameters.
            Some(_) => Clift::new(&config.model, config.seed, device),
            None => start(sink)?,
        };
        let loss = Loss::load(&config.loss, device)?;
        for term in loss.describe() {
            sink.event(&Event::Message(term));
        }
        let mut train_state = TrainState {
            loss,
            activation_checkpointing: config.activation_checkpointing,
            loss_scale: LossScale::of(config.precision),
            ..TrainState::new(model, optimizer, device.clone())
        };
        let progress = checkpoints.resume(&mut train_state)?.unwrap_or_default();
        train_state.model = freeze(stage, train_state.model);
        make_folder(folder).map_err(TrainError::io("making a folder", folder))?;
        let mut log = RunLog::open(&config.run_dir, stage, progress.step, sink)?;
        log.event(&Event::StageStarted { stage, done: progress.step, num_steps });

        let mut training = TrainLoop::new(self, checkpoints, progress, validation, stop, log);
        let model = training.run(train_state).map_err(|error| training.name_checkpoint(error))?;
        training.log.event(&Event::StageFinished { stage, elapsed_s: started.elapsed().as_secs_f64() });
        Ok(model)
    }

    /// Starts to make the batches of the steps after `step`.
    pub(crate) fn prefetch(&self, step: u64) -> Prefetcher<StageBatch, TrainError> {
        let (data, make) = (&self.config.data, self.batches.clone());
        Prefetcher::new(move |step| make(step), step, self.settings.steps, data.num_threads, data.num_prefetch)
    }

    /// Returns the learning rates of a step: `lr`, and for the renderer `lr` times its factor.
    pub(crate) fn learning_rate(&self, lr: f64) -> ModuleLearningRate {
        let renderer = DynLrScheduler::from(lr * self.settings.renderer_lr_factor);
        ModuleLrScheduler::new(lr).with_group(ParamGroup::from_predicate("renderer"), renderer).step()
    }
}
