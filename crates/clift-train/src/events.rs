//! Events of a run, which sinks print or write to files.

use std::path::PathBuf;

use clift_eval::EvalEvent;
use serde::{Deserialize, Serialize};

/// A training stage.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, strum::IntoStaticStr)]
#[serde(rename_all = "snake_case")]
#[strum(serialize_all = "snake_case")]
pub enum Stage {
    /// Encoder and renderer.
    Stage1,
    /// Condenser, and the renderer at a smaller learning rate.
    Stage2,
}

impl Stage {
    /// Returns the name in files, on the command line and of folders.
    pub fn name(self) -> &'static str {
        self.into()
    }
}

/// A step of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RunStep {
    /// The updates of a stage.
    Train(Stage),
    /// The cluster cache, on which stage 2 trains.
    Clusters,
    /// The evaluation after training.
    Eval,
}

impl RunStep {
    /// Returns the name in files, on the command line and of folders.
    pub fn name(self) -> &'static str {
        match self {
            Self::Train(stage) => stage.name(),
            Self::Clusters => "clusters",
            Self::Eval => "eval",
        }
    }
}

impl From<Stage> for RunStep {
    fn from(stage: Stage) -> Self {
        Self::Train(stage)
    }
}

/// One optimizer update; with its time a line of `metrics.jsonl`, where NaN and infinity are written as `null`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct StepEvent {
    /// Step of the stage, from 1.
    pub step: u64,
    /// The stage.
    pub stage: Stage,
    /// Last step of the stage.
    #[serde(skip)]
    pub last_step: u64,
    /// Training loss of the batch.
    pub loss: f64,
    /// PSNR of the batch in dB.
    pub psnr: f64,
    /// Learning rate of the first parameter group.
    pub lr: f64,
    /// Global norm of the gradient before clipping.
    pub grad_norm: f64,
    /// Seconds of wall time.
    pub step_s: f64,
    /// Target images of the batch per second of the update.
    pub images_per_s: f64,
    /// Peak memory of the process so far; `None` if the system does not report it.
    pub peak_bytes: Option<u64>,
}

/// An event of a run. Steps count from 1 in their stage, `done` ones are finished; times are in seconds, PSNR in dB.
#[derive(Clone, Debug, PartialEq)]
#[expect(missing_docs, reason = "the fields are described with their variants")]
pub enum Event {
    /// A step of the run starts, or resumes at a checkpoint. The cluster cache has context sets as its steps.
    StepStarted { run_step: RunStep, done: u64, num_steps: u64 },
    /// An update was made.
    Step(StepEvent),
    /// The first steps of a new stage were measured: mean wall time of a step with its batch, without the first step.
    Pace { stage: Stage, step: u64, step_s: f64 },
    /// Chunks of a data set were examined, of all that are.
    Scan { done: usize, total: usize },
    /// A context set of the cluster cache or a scene of an evaluation was processed.
    Progress { run_step: RunStep, done: u64, total: u64 },
    /// Validation views were measured. SSIM is `None` for images below 11 pixels.
    Evaluated { stage: Stage, step: u64, psnr: f64, ssim: Option<f64>, num_views: usize },
    /// A checkpoint was saved in a folder.
    Checkpoint { path: PathBuf },
    /// A scene was skipped.
    Skipped { key: String, reason: String },
    /// A problem that does not stop the run.
    Warning(String),
    /// Information for the log.
    Message(String),
    /// A step of the run is finished, so long after the start or the resumption.
    StepFinished { run_step: RunStep, elapsed_s: f64 },
}

/// Receiver of events. A sink does not stop a run; a failing one reports the failure at the end.
pub trait Sink {
    /// Receives one event.
    fn event(&mut self, event: &Event);
}

impl<F: FnMut(&Event)> Sink for F {
    fn event(&mut self, event: &Event) {
        self(event);
    }
}

/// Returns a receiver of the events of an evaluation that passes them on as events of a run. Scenes are counted only if
/// `is_stage`: not in a validation.
pub(crate) fn eval_events(sink: &mut dyn Sink, is_stage: bool) -> impl FnMut(EvalEvent<'_>) {
    let run_step = RunStep::Eval;
    move |event: EvalEvent| {
        sink.event(&match event {
            EvalEvent::Done(..) if !is_stage => return,
            EvalEvent::Done(0, total) => Event::StepStarted { run_step, done: 0, num_steps: total as u64 },
            EvalEvent::Done(done, total) => Event::Progress { run_step, done: done as u64, total: total as u64 },
            EvalEvent::Note(text) => Event::Message(text.into()),
            EvalEvent::Skipped(key, reason) => Event::Skipped { key: key.into(), reason: reason.into() },
        });
    }
}
