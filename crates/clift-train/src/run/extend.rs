//! `--extend`: trains a stage of an existing run for more steps.
//!
//! The steps made so far are kept. The following steps use the learning rates and image sizes of a run with the new number of
//! steps: the rate jumps to the cosine of that run and decays to zero at the new end. The result therefore differs from a run that
//! had the new number from the start, and `run.json` records the extension. Steps with images of half the size after steps with
//! whole ones are refused.

use clift_scene::TokenCodec;
use serde::{Deserialize, Serialize};

use crate::checkpoint::checkpoints::Checkpoints;
use crate::config::config::{CheckpointConfig, Config};
use crate::error::{TrainError, bad};
use crate::events::{Event, Sink, Stage};

/// A larger number of steps for a stage.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct StepExtension {
    pub stage: Stage,
    /// The former number of steps.
    pub from: u64,
    /// The new number of steps.
    pub to: u64,
}

/// Record of an extension in `run.json`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct ExtensionRecord {
    stage: Stage,
    from: u64,
    to: u64,
    /// Number of steps made with the former schedule.
    at_step: u64,
}

impl StepExtension {
    /// Checks that the stage of the run of `config`, which has the new number, can be extended. Changes no file.
    ///
    /// # Errors
    /// [`TrainError::BadConfig`] if it cannot, [`TrainError::Io`].
    pub fn check(self, config: &Config) -> Result<ExtensionRecord, TrainError> {
        let Self { stage, from, to } = self;
        let folder = &config.run_dir;
        let refuse = |fix: &str| bad("--extend", format!("{}.steps {from} -> {to}", stage.name()), fix);
        let later = ["clusters", "stage2"].into_iter().find(|name| folder.join(name).exists());
        if let (Stage::Stage1, Some(later)) = (stage, later) {
            let fix = format!(
                "{later}/ depends on the present encoder of stage 1; start a new run with stage1.init_from instead"
            );
            return Err(refuse(&fix));
        }
        let own = folder.join(stage.name());
        let newest = Checkpoints::new(own.join("checkpoints"), CheckpointConfig::default()).newest_step()?;
        let at_step = newest.unwrap_or(0);
        if stage == Stage::Stage1 {
            let [half_from, half_to] = [from, to].map(|steps| config.stage1.half_resolution_steps(steps));
            if half_from < at_step && at_step < half_to {
                let most = config.stage1.most_steps(at_step);
                let fix = format!(
                    "images would have half the width and height again (stage1.half_resolution): write at most {most}, or \
                     start a new run with stage1.init_from"
                );
                return Err(refuse(&fix));
            }
        }
        if newest.is_none() && own.join("model.safetensors").exists() {
            let fix = format!("the stage has no checkpoint to resume from in {}/checkpoints", stage.name());
            return Err(refuse(&fix));
        }
        Ok(ExtensionRecord { stage, from, to, at_step })
    }
}

impl ExtensionRecord {
    /// Renames the weights of a finished stage. To be called before the new number of steps is in the run directory: a process
    /// killed in between makes these weights again.
    pub fn keep_weights(self, config: &Config, sink: &mut dyn Sink) -> Result<(), TrainError> {
        let Self { stage, from, to, at_step } = self;
        let own = config.run_dir.join(stage.name());
        let weights = own.join("model.safetensors");
        if weights.exists() {
            let kept = own.join(format!("model-{from}-steps.safetensors"));
            let codecs = [weights.as_path(), &kept].map(TokenCodec::path_of);
            if codecs[0].exists() {
                std::fs::rename(&codecs[0], &codecs[1])
                    .map_err(TrainError::io("renaming the former codec", &codecs[0]))?;
            }
            std::fs::rename(&weights, &kept).map_err(TrainError::io("renaming the former weights", &weights))?;
            sink.event(&Event::Message(format!("kept the weights of {from} steps as {}", kept.display())));
        }
        sink.event(&Event::Message(format!(
            "{} is extended from {from} to {to} steps: the steps after {at_step} use the learning rates of {to} steps",
            stage.name()
        )));
        Ok(())
    }
}
