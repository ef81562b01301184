//! What a run tells: typed events, which sinks write to the disk or show to people.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

/// One part of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, strum::IntoStaticStr)]
#[serde(rename_all = "snake_case")]
#[strum(serialize_all = "snake_case")]
pub enum Stage {
    /// Encoder and renderer.
    Stage1,
    /// The cache of clusters that stage 2 trains on.
    Clusters,
    /// Condenser, with the renderer at a smaller rate.
    Stage2,
    /// The measurement of held-out views after training.
    Eval,
}

impl Stage {
    /// The name in files, on the command line and in folders.
    pub fn name(self) -> &'static str {
        self.into()
    }
}

/// One optimiser update.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StepEvent {
    /// Which stage.
    pub stage: Stage,
    /// Updates so far in this stage, from 1.
    pub step: u64,
    /// Updates the stage will have.
    pub num_steps: u64,
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
}

/// Something that happened in a run.
#[derive(Clone, Debug, PartialEq)]
pub enum Event {
    /// A stage begins or is resumed.
    StageStarted {
        /// Which stage.
        stage: Stage,
        /// Steps done before: 0, or the step of the checkpoint it resumes from.
        done: u64,
        /// Steps (scenes, for the clusters) it will have.
        num_steps: u64,
    },
    /// An update was made.
    Step(StepEvent),
    /// A part of a stage that makes no updates is done: a scene was clustered.
    Progress {
        /// Which stage.
        stage: Stage,
        /// How many are done.
        done: u64,
        /// How many there are.
        total: u64,
    },
    /// Held-out views were measured.
    Evaluated {
        /// Which stage.
        stage: Stage,
        /// Updates so far in this stage.
        step: u64,
        /// Mean PSNR in dB.
        psnr: f64,
        /// Mean SSIM; `None` for pictures below 11 pixels.
        ssim: Option<f64>,
        /// How many views.
        num_views: usize,
    },
    /// A checkpoint is on the disk.
    Checkpoint {
        /// Its folder.
        path: PathBuf,
    },
    /// A scene, frame or batch was left out.
    Skipped {
        /// What.
        key: String,
        /// Why.
        reason: String,
    },
    /// Something is wrong and the run goes on.
    Warning(String),
    /// Something worth a line.
    Message(String),
    /// A stage is done.
    StageFinished {
        /// Which stage.
        stage: Stage,
        /// Seconds of wall time since it started or resumed.
        elapsed_s: f64,
    },
}

/// Takes events as they happen. A sink never stops a run: one that fails reports that at its end.
pub trait Sink {
    /// Takes one event.
    fn event(&mut self, event: &Event);
}
