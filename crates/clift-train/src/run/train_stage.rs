//! Trains one stage, new or resumed, to its last step.

use std::sync::atomic::AtomicBool;
use std::time::Instant;

use clift_data::make_folder;
use clift_model::Clift;

use crate::error::TrainError;
use crate::events::{Event, Sink};
use crate::run::logs::RunLog;
use crate::run::stage_plan::{StagePlan, freeze};
use crate::run::train_loop::TrainLoop;
use crate::run::validation::Validation;
use crate::stage::settings::StageSettings;
use crate::step::loss::Loss;
use crate::step::loss_scale::LossScale;
use crate::step::optimizer::adamw;
use crate::step::train_state::TrainState;

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
        let StageSettings { stage, steps: num_steps, optimizer, .. } = self.settings;
        let checkpoints = self.checkpoints();
        let model = if checkpoints.newest()?.is_some() { self.blank_model() } else { start(sink)? };
        let loss = Loss::load(&self.config.loss, &self.device)?;
        for term in loss.describe() {
            sink.event(&Event::Message(term));
        }
        let mut train_state = TrainState {
            model,
            optimizer: adamw(optimizer),
            device: self.device.clone(),
            loss,
            activation_checkpointing: self.config.activation_checkpointing,
            loss_scale: LossScale::of(self.config.precision),
        };
        let progress = checkpoints.resume(&mut train_state)?.unwrap_or_default();
        train_state.model = freeze(stage, train_state.model);
        make_folder(&self.folder).map_err(TrainError::io("making a folder", &self.folder))?;
        let run_dir = self.folder.parent().unwrap_or(&self.folder);
        let mut log = RunLog::open(run_dir, stage, progress.step, sink)?;
        log.event(&Event::StageStarted { stage, done: progress.step, num_steps });

        let mut training = TrainLoop::new(self, checkpoints, progress, validation, stop, log);
        let model = training.run(train_state).map_err(|error| training.name_checkpoint(error))?;
        training.log.event(&Event::StageFinished { stage, elapsed_s: started.elapsed().as_secs_f64() });
        Ok(model)
    }
}
