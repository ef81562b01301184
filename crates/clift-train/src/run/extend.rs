//! `--extend`: a stage of a run trained for more steps than it was started with.
//!
//! The steps made so far stay as they are. Those to come have the learning rates of a run that has the new count: the rate
//! jumps up to where that run's cosine is at the same step, and comes down to zero at the new end. The result is
//! therefore not that of a run that had the count from the start; `run.json` says so.

use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::checkpoint::checkpoints::Checkpoints;
use crate::config::config::CheckpointConfig;
use crate::error::TrainError;
use crate::events::{Event, Sink, Stage};

/// A step count that grows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct StepExtension {
    /// Which stage.
    pub stage: Stage,
    /// Its steps until now.
    pub from: u64,
    /// Its steps from now on.
    pub to: u64,
}

/// What `run.json` says about one that was made.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct ExtensionRecord {
    stage: Stage,
    from: u64,
    to: u64,
    /// Steps that were made on the former schedule.
    at_step: u64,
}

impl StepExtension {
    /// Prepares the stage of the run in `folder` to go on. Weights of a finished stage are kept under another name.
    ///
    /// # Errors
    /// [`TrainError::BadConfig`] where the stage cannot go on, [`TrainError::Io`].
    pub fn apply(self, folder: &Path, sink: &mut dyn Sink) -> Result<ExtensionRecord, TrainError> {
        let Self { stage, from, to } = self;
        let refuse = |fix: String| {
            let value = format!("{}.steps {from} -> {to}", stage.name());
            TrainError::BadConfig { key: "--extend".into(), value, fix }
        };
        let later = ["clusters", "stage2"].into_iter().find(|name| folder.join(name).exists());
        if let (Stage::Stage1, Some(later)) = (stage, later) {
            let fix = format!(
                "{later}/ was made with the encoder that stage 1 has now; train on in a new run that starts from this one \
                 (stage1.init_from)"
            );
            return Err(refuse(fix));
        }
        let own = folder.join(stage.name());
        let newest = Checkpoints::new(own.join("checkpoints"), CheckpointConfig::default()).newest_step()?;
        let weights = own.join("model.safetensors");
        if weights.exists() {
            if newest.is_none() {
                return Err(refuse(format!("{}/checkpoints, from which the stage would go on, is gone", stage.name())));
            }
            // Before the new count is written: a kill in between leaves a stage that makes these weights again.
            let kept = own.join(format!("model-{from}-steps.safetensors"));
            std::fs::rename(&weights, &kept).map_err(TrainError::io("keeping the former weights", &weights))?;
            sink.event(&Event::Message(format!("kept the weights of {from} steps as {}", kept.display())));
        }
        let at_step = newest.unwrap_or(0);
        sink.event(&Event::Message(format!(
            "{} goes on for {to} steps instead of {from}: after step {at_step} with the learning rates of {to}",
            stage.name()
        )));
        Ok(ExtensionRecord { stage, from, to, at_step })
    }
}
