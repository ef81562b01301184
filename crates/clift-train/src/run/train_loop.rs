//! Training of a stage, new or resumed: step, save, validate, until the last step, an interrupt or an error.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use burn::module::{Module, ParamGroup};
use burn::optim::lr_scheduler::DynLrScheduler;
use burn::optim::lr_scheduler::module_lr_scheduler::{ModuleLearningRate, ModuleLrScheduler};
use burn::tensor::Device;
use clift_core::{make_folder, plural};
use clift_data::Prefetcher;
use clift_eval::peak_bytes;
use clift_model::{Network, psnr_of_mse, weights_hash};

use crate::checkpoint::checkpoints::Checkpoints;
use crate::checkpoint::progress::TrainingPosition;
use crate::config::config::Config;
use crate::distributed::parts::BatchParts;
use crate::distributed::ranks::Ranks;
use crate::error::TrainError;
use crate::events::{Event, Sink, StepEvent};
use crate::run::logs::RunLog;
use crate::run::run_file::require_run;
use crate::run::validation::Validation;
use crate::stage::settings::{StageSettings, freeze};
use crate::step::batch::StageBatch;
use crate::step::loss::Loss;
use crate::step::loss_scale::LossScale;
use crate::step::schedule::learning_rate;
use crate::step::step_guard::{BatchScenes, LossHistory, SkippedStep, StepAnomaly};
use crate::step::train_state::{TrainState, Update};

/// Makes the batch of a step; called from several threads.
pub type MakeBatch = dyn Fn(u64) -> Result<StageBatch, TrainError> + Send + Sync;

pub struct StagePlan<'a> {
    pub settings: StageSettings<'a>,
    pub batches: Arc<MakeBatch>,
    pub config: &'a Config,
    pub folder: PathBuf,
    pub device: Device,
    pub ranks: &'a Ranks,
    pub parts: BatchParts,
}

/// Steps of a new stage after which its pace is reported.
const PACE_STEPS: u64 = 20;

/// Most threads that prepare batches where the config sets no number.
const MAX_THREADS: usize = 16;

impl StagePlan<'_> {
    fn prefetch(&self, step: u64) -> Prefetcher<StageBatch, TrainError> {
        let (data, make) = (&self.config.data, self.batches.clone());
        // A CPU trains on all threads.
        let unset = if self.config.device.is_cpu() { 1 } else { rayon::current_num_threads().min(MAX_THREADS) };
        let threads = data.num_threads.unwrap_or(unset);
        Prefetcher::new(move |step| make(step), step, self.settings.steps, threads, data.num_prefetch.max(threads))
    }

    /// Returns the learning rates of a step: `lr`, and for the renderer `lr` times its factor.
    fn learning_rate(&self, lr: f64) -> ModuleLearningRate {
        let renderer = DynLrScheduler::from(lr * self.settings.renderer_lr_factor);
        ModuleLrScheduler::new(lr).with_group(ParamGroup::from_predicate("renderer"), renderer).step()
    }
}

/// Trains the remaining steps of a stage and returns the model. `start` makes the initial model if there is no checkpoint.
pub(crate) fn train_stage(
    plan: &StagePlan,
    start: impl FnOnce(&mut dyn Sink) -> Result<Network, TrainError>,
    validation: &Validation,
    stop: &AtomicBool,
    sink: &mut dyn Sink,
) -> Result<Network, TrainError> {
    let started = Instant::now();
    let StagePlan { settings, config, folder, device, ranks, .. } = plan;
    let StageSettings { stage, steps: num_steps, optimizer, .. } = *settings;
    let checkpoints = Checkpoints { folder: folder.join("checkpoints"), model: Some(config.model.clone()) };
    let newest = ranks.from_root(|| {
        require_run(&config.run_dir)?;
        checkpoints.newest_step()
    })?;
    let model = match newest {
        // The checkpoint replaces all parameters.
        Some(_) => Network::new(&config.model, config.seed, device),
        None => start(sink)?,
    };
    let loss = Loss::load(&config.loss, device)?;
    if let Some(term) = loss.describe() {
        sink.event(&Event::Message(term));
    }
    let mut train_state = TrainState {
        loss,
        precision: config.precision,
        loss_scale: LossScale::of(config.precision),
        ..TrainState::new(model, optimizer, device.clone())
    };
    let progress = match newest {
        Some(step) => {
            if ranks.is_root() {
                // Each save removes unfinished saves, but a finished stage makes no further save.
                checkpoints.remove_unfinished()?;
            }
            checkpoints.load(step, &mut train_state)?
        }
        None => TrainingPosition::default(),
    };
    train_state.model = freeze(stage, train_state.model);
    let mut log = if ranks.is_root() {
        make_folder(folder).map_err(TrainError::io("making a folder", folder))?;
        RunLog::open(&config.run_dir, stage, [progress.step, progress.validated], sink)?
    } else {
        RunLog::silent(sink)
    };
    require_same_weights(&train_state, ranks)?;
    if ranks.num_ranks() > 1 {
        let (num_ranks, num_parts) = (ranks.num_ranks(), plan.parts.num_parts());
        let scenes = plural(plan.parts.batch_size(), "scene");
        log.event(&Event::Message(format!("{num_ranks} ranks share batches of {scenes} in {num_parts} parts")));
    }
    log.event(&Event::StepStarted { run_step: stage.into(), done: progress.step, num_steps });

    let saved = progress.step;
    let mut training = TrainLoop { plan, checkpoints, progress, saved, validation, stop, log };
    let model = training.run(train_state).map_err(|error| training.name_checkpoint(error))?;
    training.log.event(&Event::StepFinished { run_step: stage.into(), elapsed_s: started.elapsed().as_secs_f64() });
    Ok(model)
}

struct TrainLoop<'a> {
    plan: &'a StagePlan<'a>,
    checkpoints: Checkpoints,
    progress: TrainingPosition,
    /// Step of the newest checkpoint; 0 for none.
    saved: u64,
    validation: &'a Validation<'a>,
    stop: &'a AtomicBool,
    log: RunLog<'a>,
}

impl TrainLoop<'_> {
    fn run(&mut self, mut train_state: TrainState) -> Result<Network, TrainError> {
        // The process may have been killed between a checkpoint and the validation of its step.
        self.validate_if_due(&train_state)?;
        // The first step of a new stage is not measured: it may compile kernels.
        let (is_new, mut measured, mut asked) = (self.progress.step == 0, 0.0, Instant::now());
        for batch in self.plan.prefetch(self.progress.step) {
            // Also an error of another rank.
            let batch = batch.and_then(|batch| {
                let scenes = BatchScenes::gather(&batch, self.plan.parts, self.plan.ranks)?;
                Ok((batch, scenes))
            });
            let (batch, scenes) = match batch {
                Ok(batch) => batch,
                Err(error) => return Err(self.save_before(error, &train_state)),
            };
            train_state = self.step(train_state, &batch, &scenes)?;
            let (stage, step) = (self.plan.settings.stage, self.progress.step);
            if step > 1 {
                measured += asked.elapsed().as_secs_f64();
            }
            if is_new && step == PACE_STEPS {
                self.log.event(&Event::Pace { stage, step, step_s: measured / (PACE_STEPS - 1) as f64 });
            }
            let is_stopped = self.plan.ranks.any(self.stop.load(Ordering::Relaxed))?;
            if is_stopped || self.is_checkpoint_due() {
                self.save(&train_state)?;
            }
            if is_stopped && !self.is_last() {
                return Err(TrainError::Interrupted { step: self.progress.step });
            }
            if let Err(error) = self.validate_if_due(&train_state) {
                return Err(self.save_before(error, &train_state));
            }
            asked = Instant::now();
        }
        self.log.check()?;
        Ok(train_state.model)
    }

    fn step(
        &mut self,
        train_state: TrainState,
        batch: &StageBatch,
        scenes: &BatchScenes,
    ) -> Result<TrainState, TrainError> {
        let started = Instant::now();
        let StageSettings { stage, steps: last_step, half_resolution_steps, batch_size, optimizer, .. } =
            self.plan.settings;
        let step = self.progress.step + 1;
        for skip in &scenes.skipped {
            self.log.skip(stage, step, skip);
        }
        let lr = learning_rate(optimizer, step, last_step);
        if step == half_resolution_steps + 1 {
            // Loss and gradient norm of smaller images say nothing about the following steps.
            self.progress.recent = LossHistory::default();
        }
        let (rate, recent) = (self.plan.learning_rate(lr), &self.progress.recent);
        let mut anomaly = None;
        // Checked before the update: a skipped step does not change the weights.
        let accept = |loss, grad_norm| {
            anomaly = recent.anomaly(loss, grad_norm, optimizer);
            anomaly.is_none()
        };
        let ranks = (self.plan.parts, self.plan.ranks);
        let (mut train_state, update) = train_state.step_if(batch, ranks, rate, optimizer.max_grad_norm, accept)?;
        self.progress.step = step;
        let step_s = started.elapsed().as_secs_f64();
        let num_images = batch_size * self.plan.config.data.views.num_targets;
        self.log.event(&Event::Step(StepEvent {
            stage,
            step,
            last_step,
            loss: update.loss,
            psnr: psnr_of_mse(update.mse),
            lr,
            grad_norm: update.grad_norm,
            step_s,
            images_per_s: num_images as f64 / step_s.max(1e-9),
            peak_bytes: peak_bytes(),
        }));
        if train_state.adapt_loss_scale(&update) {
            // An overflow is not an anomaly of the batch.
            let factor = train_state.loss_scale.map_or(1.0, |scale| scale.factor());
            let text = format!("skipped step {step}: a gradient overflowed in f16; the loss scale is now {factor}");
            self.log.event(&Event::Message(text));
            return Ok(train_state);
        }
        match anomaly {
            None => {
                self.progress.bad_steps = 0;
                self.progress.recent.push(update.loss, update.grad_norm);
            }
            Some(anomaly) => self.skip_step(anomaly, update, scenes)?,
        }
        Ok(train_state)
    }

    /// Counts and logs a step without update; [`TrainError::Diverged`] after `max_bad_steps` consecutive ones.
    fn skip_step(&mut self, anomaly: StepAnomaly, update: Update, batch: &BatchScenes) -> Result<(), TrainError> {
        self.progress.bad_steps += 1;
        self.progress.num_bad_steps += 1;
        let finite = |value: f64| value.is_finite().then_some(value);
        let [median_loss, median_grad_norm] = self.progress.recent.medians();
        let line = SkippedStep {
            step: self.progress.step,
            stage: self.plan.settings.stage,
            reason: anomaly,
            loss: finite(update.loss),
            grad_norm: finite(update.grad_norm),
            median_loss,
            median_grad_norm,
            in_a_row: self.progress.bad_steps,
            scenes: batch.scenes.clone(),
        };
        self.log.bad_steps.write(&line);
        let keys = line.scenes.iter().map(|scene| scene.key.as_str()).collect::<Vec<_>>().join(", ");
        let TrainingPosition { step, bad_steps: count, .. } = self.progress;
        if count < self.plan.settings.optimizer.max_bad_steps {
            self.log.event(&Event::Warning(format!("skipped step {step}: {anomaly} (scenes {keys})")));
            return Ok(());
        }
        self.log.check()?;
        let checkpoint = self.newest_checkpoint();
        Err(TrainError::Diverged { count, step, reason: anomaly.to_string(), keys, checkpoint })
    }

    /// Saves on rank 0, after a check that all ranks have the same weights.
    fn save(&mut self, train_state: &TrainState) -> Result<(), TrainError> {
        let ranks = self.plan.ranks;
        require_same_weights(train_state, ranks)?;
        ranks.from_root(|| self.save_alone(train_state))?;
        self.saved = self.progress.step;
        Ok(())
    }

    fn save_alone(&mut self, train_state: &TrainState) -> Result<(), TrainError> {
        require_run(&self.plan.config.run_dir)?;
        // A resumed run does not write the lines of these steps again.
        self.log.check()?;
        let path = self.checkpoints.save(train_state, &self.progress, self.plan.config.checkpoint.keep)?;
        self.log.event(&Event::Checkpoint { path });
        Ok(())
    }

    /// Saves the steps made so far before the run ends with `error`, which they did not cause. Sends no message: another
    /// rank may have ended.
    fn save_before(&mut self, error: TrainError, train_state: &TrainState) -> TrainError {
        if self.plan.ranks.is_root()
            && self.saved < self.progress.step
            && let Err(second) = self.save_alone(train_state)
        {
            self.log.event(&Event::Warning(format!("saving the steps made so far failed: {second}")));
        }
        error
    }

    /// Validates the step if it is due and was not validated before.
    fn validate_if_due(&mut self, train_state: &TrainState) -> Result<(), TrainError> {
        let TrainingPosition { step, bad_steps, validated, .. } = self.progress;
        let is_due = self.is_last() || (is_multiple(step, self.plan.config.eval.every) && bad_steps == 0);
        if !is_due || validated == step {
            return Ok(());
        }
        let ranks = self.plan.ranks;
        let has_result = ranks.from_root(|| {
            require_run(&self.plan.config.run_dir)?;
            let (stage, samples) = (self.plan.settings.stage, self.plan.folder.join("samples"));
            let model = train_state.model.valid();
            self.validation.validate(&model, stage, step, &samples, self.stop, &mut self.log)
        })?;
        if has_result {
            self.progress.validated = step;
            let has_checkpoint = ranks.is_root() && self.is_checkpoint_due();
            return if has_checkpoint { self.checkpoints.update(&self.progress) } else { Ok(()) };
        }
        // Without a result, a resumed run validates again.
        if ranks.any(self.stop.load(Ordering::Relaxed))? {
            if self.saved < step {
                self.save(train_state)?;
            }
            return Err(TrainError::Interrupted { step });
        }
        Ok(())
    }

    fn is_checkpoint_due(&self) -> bool {
        self.is_last() || is_multiple(self.progress.step, self.plan.config.checkpoint.every)
    }

    fn is_last(&self) -> bool {
        self.progress.step == self.plan.settings.steps
    }

    fn newest_checkpoint(&self) -> String {
        let newest = self.checkpoints.newest_step().ok().flatten();
        newest.map_or("none".into(), |step| self.checkpoints.path_of(step).display().to_string())
    }

    /// Adds the last step and the newest checkpoint to an error.
    fn name_checkpoint(&self, error: TrainError) -> TrainError {
        let is_complete =
            matches!(error, TrainError::Interrupted { .. } | TrainError::Diverged { .. } | TrainError::Moved { .. });
        if is_complete || self.progress.step == 0 {
            return error;
        }
        TrainError::Stopped {
            source: Box::new(error),
            stage: self.plan.settings.stage.name(),
            step: self.progress.step,
            checkpoint: self.newest_checkpoint(),
        }
    }
}

fn require_same_weights(train_state: &TrainState, ranks: &Ranks) -> Result<(), TrainError> {
    if ranks.num_ranks() == 1 {
        return Ok(());
    }
    ranks.require_same("the weights", &weights_hash(&train_state.model))
}

fn is_multiple(step: u64, every: u64) -> bool {
    every > 0 && step > 0 && step.is_multiple_of(every)
}
