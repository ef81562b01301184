//! The training loop: step, save, validate, until all steps are done or something comes in between.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use clift_model::Clift;

use crate::checkpoint::checkpoints::Checkpoints;
use crate::checkpoint::progress::{Best, Progress};
use crate::error::TrainError;
use crate::events::{Event, Sink, StepEvent};
use crate::run::logs::RunLog;
use crate::run::stage_plan::StagePlan;
use crate::run::validation::Validation;
use crate::stage::settings::StageSettings;
use crate::step::batch::StageBatch;
use crate::step::loss::psnr_of;
use crate::step::schedule::warm_up_cosine;
use crate::step::step_guard::{SkippedStep, SkippedStepScene, StepAnomaly};
use crate::step::train_state::{TrainState, Update};

/// A stage while it trains.
pub(crate) struct TrainLoop<'a> {
    plan: &'a StagePlan<'a>,
    checkpoints: Checkpoints,
    progress: Progress,
    /// Step of the newest checkpoint; 0 for none.
    saved: u64,
    validation: &'a Validation<'a>,
    stop: &'a AtomicBool,
    /// What happens goes here.
    pub(crate) log: RunLog<'a>,
}

impl<'a> TrainLoop<'a> {
    /// Goes on from `progress`, which is that of the newest checkpoint.
    pub fn new(
        plan: &'a StagePlan,
        checkpoints: Checkpoints,
        progress: Progress,
        validation: &'a Validation,
        stop: &'a AtomicBool,
        log: RunLog<'a>,
    ) -> Self {
        Self { plan, checkpoints, saved: progress.step, progress, validation, stop, log }
    }

    /// Makes the steps that are left and returns the trained model.
    pub fn run(&mut self, mut learner: TrainState) -> Result<Clift, TrainError> {
        // A kill may have come between a checkpoint and the validation of its step.
        self.validate_if_due(&learner)?;
        for batch in self.plan.prefetch(self.progress.step) {
            let batch = match batch {
                Ok(batch) => batch,
                Err(error) => return Err(self.save_before(error, &learner)),
            };
            learner = self.step(learner, &batch)?;
            let is_stopped = self.stop.load(Ordering::Relaxed);
            if is_stopped || self.is_checkpoint_due() {
                self.save(&learner)?;
            }
            if is_stopped && !self.is_last() {
                return Err(TrainError::Interrupted { step: self.progress.step });
            }
            // After the save, which a validation that fails must not cost.
            self.validate_if_due(&learner)?;
        }
        self.log.check()?;
        Ok(learner.model)
    }

    /// Makes the next step, or leaves it out.
    fn step(&mut self, learner: TrainState, batch: &StageBatch) -> Result<TrainState, TrainError> {
        let started = Instant::now();
        for skip in &batch.skipped {
            self.log.skip(self.plan.settings.stage, self.progress.step + 1, skip);
        }
        let StageSettings { steps: num_steps, accumulate, optimizer, .. } = self.plan.settings;
        let step = self.progress.step + 1;
        let lr = warm_up_cosine(step, optimizer.learning_rate, optimizer.warm_up_steps, num_steps);
        let (rate, recent) = (self.plan.learning_rate(lr), &self.progress.recent);
        let mut fault = None;
        // Looked at before the update, so that a bad batch leaves no trace in the weights.
        let accept = |loss, grad_norm| {
            fault = recent.fault(loss, grad_norm, optimizer);
            fault.is_none()
        };
        let (mut learner, update) = learner.step_if(batch, accumulate, rate, optimizer.max_grad_norm, accept)?;
        self.progress.step = step;
        self.report(update, lr, started);
        if learner.adapt_loss_scale(&update) {
            // Neither a good step nor a bad one: nothing is wrong with its batch.
            let factor = learner.loss_scale.map_or(1.0, |scale| scale.factor());
            let told = format!("step {step} left out: a gradient is beyond f16; the loss scale is {factor} now");
            self.log.event(&Event::Message(told));
            return Ok(learner);
        }
        match fault {
            None => {
                self.progress.bad_steps = 0;
                self.progress.recent.push(update.loss, update.grad_norm);
            }
            Some(fault) => self.leave_out(fault, update, batch)?,
        }
        Ok(learner)
    }

    fn report(&mut self, update: Update, lr: f64, started: Instant) {
        self.log.event(&Event::Step(StepEvent {
            stage: self.plan.settings.stage,
            step: self.progress.step,
            num_steps: self.plan.settings.steps,
            loss: update.loss,
            psnr: psnr_of(update.mse),
            lr,
            grad_norm: update.grad_norm,
            step_s: started.elapsed().as_secs_f64(),
        }));
    }

    /// Counts and notes a step that made no update; too many in a row end the run.
    fn leave_out(&mut self, fault: StepAnomaly, update: Update, batch: &StageBatch) -> Result<(), TrainError> {
        self.progress.bad_steps += 1;
        self.progress.num_bad_steps += 1;
        let finite = |value: f64| value.is_finite().then_some(value);
        let line = SkippedStep {
            step: self.progress.step,
            stage: self.plan.settings.stage,
            reason: fault,
            loss: finite(update.loss),
            grad_norm: finite(update.grad_norm),
            median_loss: self.progress.recent.median_loss(),
            median_grad_norm: self.progress.recent.median_grad_norm(),
            in_a_row: self.progress.bad_steps,
            scenes: SkippedStepScene::all(batch),
        };
        self.log.bad_step(&line);
        let keys = line.scenes.iter().map(|scene| scene.key.as_str()).collect::<Vec<_>>().join(", ");
        let Progress { step, bad_steps: count, .. } = self.progress;
        if count < self.plan.settings.optimizer.max_bad_steps {
            self.log.event(&Event::Warning(format!("step {step} left out: {fault} (scenes {keys})")));
            return Ok(());
        }
        self.log.check()?;
        let checkpoint = self.newest_checkpoint();
        Err(TrainError::Diverged { count, step, reason: fault.to_string(), keys, checkpoint })
    }

    fn save(&mut self, learner: &TrainState) -> Result<(), TrainError> {
        // Lines up to here would be missing for good.
        self.log.check()?;
        let path = self.checkpoints.save(learner, &self.progress)?;
        self.saved = self.progress.step;
        self.log.event(&Event::Checkpoint { path });
        Ok(())
    }

    /// Saves the steps made so far before the run ends with `error`, which is not theirs.
    fn save_before(&mut self, error: TrainError, learner: &TrainState) -> TrainError {
        if self.saved < self.progress.step
            && let Err(second) = self.save(learner)
        {
            self.log.event(&Event::Warning(format!("and the steps so far are not saved: {second}")));
        }
        error
    }

    /// Measures the held-out views where this step asks for it and has not been measured.
    fn validate_if_due(&mut self, learner: &TrainState) -> Result<(), TrainError> {
        let Progress { step, bad_steps, validated, .. } = self.progress;
        let is_due = self.is_last() || (is_multiple(step, self.plan.config.eval.every) && bad_steps == 0);
        if !is_due || validated == step {
            return Ok(());
        }
        let (stage, samples) = (self.plan.settings.stage, self.plan.folder.join("samples"));
        let model = learner.inference_model();
        let psnr = self.validation.validate(&model, stage, step, &samples, self.stop, &mut self.log)?;
        if psnr.is_none() && self.stop.load(Ordering::Relaxed) {
            if self.saved < step {
                self.save(learner)?;
            }
            return Err(TrainError::Interrupted { step });
        }
        // Where nothing could be measured, a resumed run tries again.
        let Some(psnr) = psnr else { return Ok(()) };
        self.progress.validated = step;
        if !self.is_checkpoint_due() {
            return Ok(());
        }
        // Of the regular checkpoints only, not of those that a signal caused: the best is the same after any kill.
        if self.progress.best.is_none_or(|best| psnr > best.psnr) {
            self.progress.best = Some(Best { step, psnr });
        }
        self.checkpoints.update(&self.progress)
    }

    fn is_checkpoint_due(&self) -> bool {
        self.is_last() || is_multiple(self.progress.step, self.plan.config.checkpoint.every)
    }

    fn is_last(&self) -> bool {
        self.progress.step == self.plan.settings.steps
    }

    fn newest_checkpoint(&self) -> String {
        let newest = self.checkpoints.newest().ok().flatten();
        newest.map_or("none".into(), |path| path.display().to_string())
    }

    /// Adds to an error where the stage stands and what there is to go on from.
    pub fn name_checkpoint(&self, error: TrainError) -> TrainError {
        let says_so = matches!(error, TrainError::Interrupted { .. } | TrainError::Diverged { .. });
        if says_so || self.progress.step == 0 {
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

fn is_multiple(step: u64, every: u64) -> bool {
    every > 0 && step > 0 && step.is_multiple_of(every)
}
