//! The training loop, the same for both stages.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use burn::module::{Module, ParamGroup};
use burn::optim::lr_scheduler::module_lr_scheduler::{ModuleLearningRate, ModuleLrScheduler};
use burn::tensor::Device;
use clift_data::Prefetcher;
use clift_model::Clift;

use crate::TrainError;
use crate::checkpoint::{Checkpoints, Progress};
use crate::config::{Config, OptimizerConfig};
use crate::events::{Event, Sink, Stage, StepEvent};
use crate::held_out::HeldOut;
use crate::loss::psnr_of;
use crate::optim::adamw;
use crate::schedule::warm_up_cosine;
use crate::sinks::{MetricsFile, Tee};
use crate::step::{Learner, StageBatch, Update};

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
    /// after too many bad steps, and whatever data, model or disk give.
    pub fn train(
        &self,
        start: impl FnOnce(&mut dyn Sink) -> Result<Clift, TrainError>,
        held_out: &HeldOut,
        stop: &AtomicBool,
        sink: &mut dyn Sink,
    ) -> Result<Clift, TrainError> {
        let Config { data, checkpoint, eval, .. } = self.config;
        let started = Instant::now();
        let samples = self.folder.join("samples");
        let checkpoints = Checkpoints::new(self.folder.join("checkpoints"), checkpoint.keep);
        let model = if checkpoints.newest()?.is_some() { self.blank_model() } else { start(sink)? };
        let mut learner = Learner { model, optimizer: adamw(self.optimizer), device: self.device.clone() };
        let mut progress = checkpoints.resume(&mut learner)?.unwrap_or_default();
        learner.model = freeze(self.stage, learner.model);
        let mut metrics = self.open_metrics(progress.step)?;
        let mut sink = Tee::new(vec![sink, &mut metrics]);
        sink.event(&Event::StageStarted { stage: self.stage, done: progress.step, num_steps: self.num_steps });

        let make = self.batches.clone();
        let batches =
            Prefetcher::new(move |step| make(step), progress.step, self.num_steps, data.num_threads, data.num_prefetch);
        for batch in batches {
            let (batch, step_started) = (batch?, Instant::now());
            for skip in &batch.skipped {
                sink.event(&Event::Skipped { key: skip.key.clone(), reason: skip.reason.clone() });
            }
            let step = progress.step + 1;
            let lr = warm_up_cosine(step, self.optimizer.learning_rate, self.optimizer.warm_up_steps, self.num_steps);
            let rate = self.learning_rate(lr);
            let update = learner.step(&batch, self.accumulate, rate, self.optimizer.max_grad_norm)?;
            progress = Progress { step, bad_steps: if update.applied { 0 } else { progress.bad_steps + 1 } };
            self.report(update, step, lr, step_started, &mut sink);
            if progress.bad_steps > 0 {
                self.note_bad_step(progress, &batch, &checkpoints, &mut sink)?;
            }
            let last = step == self.num_steps;
            let interrupted = stop.load(Ordering::Relaxed);
            if due(step, checkpoint.every) || last || interrupted {
                sink.event(&Event::Checkpoint { path: checkpoints.save(&learner, progress)? });
            }
            if interrupted && !last {
                return Err(TrainError::Interrupted { step });
            }
            // After the save, which a validation that fails must not cost.
            if due(step, eval.every) && !last && progress.bad_steps == 0 {
                held_out.validate(&learner.inference_model(), self.stage, step, &samples, stop, &mut sink)?;
            }
        }
        held_out.validate(&learner.inference_model(), self.stage, self.num_steps, &samples, stop, &mut sink)?;
        sink.event(&Event::StageFinished { stage: self.stage, elapsed_s: started.elapsed().as_secs_f64() });
        drop(sink);
        let path = metrics.path().to_owned();
        metrics.finish().map_err(TrainError::io("writing the metrics", &path))?;
        Ok(learner.model)
    }

    /// A model whose parameters a checkpoint is about to replace.
    fn blank_model(&self) -> Clift {
        Clift::new(&self.config.model, self.config.seed, &self.device)
    }

    fn learning_rate(&self, lr: f64) -> ModuleLearningRate {
        let renderer = ParamGroup::from_predicate("renderer");
        ModuleLrScheduler::new(lr).with_group(renderer, constant(lr * self.renderer_lr_factor)).step()
    }

    fn open_metrics(&self, step: u64) -> Result<MetricsFile, TrainError> {
        std::fs::create_dir_all(&self.folder).map_err(TrainError::io("making a folder", &self.folder))?;
        let path = self.folder.with_file_name("metrics.jsonl");
        MetricsFile::open(&path, self.stage, step).map_err(TrainError::io("opening the metrics", &path))
    }

    fn report(&self, update: Update, step: u64, lr: f64, started: Instant, sink: &mut dyn Sink) {
        sink.event(&Event::Step(StepEvent {
            stage: self.stage,
            step,
            num_steps: self.num_steps,
            loss: update.loss,
            psnr: psnr_of(update.loss),
            lr,
            grad_norm: update.grad_norm,
            step_s: started.elapsed().as_secs_f64(),
        }));
    }

    fn note_bad_step(
        &self,
        progress: Progress,
        batch: &StageBatch,
        checkpoints: &Checkpoints,
        sink: &mut dyn Sink,
    ) -> Result<(), TrainError> {
        let Progress { step, bad_steps: count } = progress;
        let keys: Vec<&str> = batch.clips.iter().map(|clip| clip.key.as_str()).collect();
        let keys = keys.join(", ");
        if count < self.optimizer.max_bad_steps {
            let text = format!("step {step} left out: loss or gradient is not finite (scenes {keys})");
            sink.event(&Event::Warning(text));
            return Ok(());
        }
        let checkpoint = checkpoints.newest()?.map_or("none".into(), |path| path.display().to_string());
        Err(TrainError::Diverged { count, step, keys, checkpoint })
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

fn due(step: u64, every: u64) -> bool {
    every > 0 && step.is_multiple_of(every)
}

fn constant(lr: f64) -> burn::optim::lr_scheduler::DynLrScheduler {
    lr.into()
}
