//! Skipped steps: detection of anomalies, and the lines of `bad_steps.jsonl`.

use std::collections::VecDeque;

use clift_core::median;
use clift_data::{Clip, SkippedScene};
use serde::{Deserialize, Serialize};

use crate::config::config::OptimizerConfig;
use crate::distributed::parts::BatchParts;
use crate::distributed::ranks::Ranks;
use crate::error::TrainError;
use crate::events::Stage;
use crate::step::batch::StageBatch;

/// Number of good steps with which a step is compared.
const WINDOW: usize = 101;
/// Fewest steps for a median: losses vary widely in the first steps of a run.
const MIN_STEPS: usize = 20;

/// Reason for skipping a step.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, strum::Display)]
#[serde(rename_all = "snake_case")]
pub enum StepAnomaly {
    /// Loss or gradient norm was a NaN or an infinity.
    #[strum(to_string = "loss or gradient is not finite")]
    NotFinite,
    /// The loss was more than `spike_factor` times its running median.
    #[strum(to_string = "the loss is a spike")]
    LossSpike,
    /// The gradient norm was more than `spike_factor` times its running median.
    #[strum(to_string = "the gradient norm is a spike")]
    GradNormSpike,
}

/// Loss and gradient norm of the last good steps. Part of a checkpoint: a resumed run makes the same decisions.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LossHistory {
    losses: VecDeque<f64>,
    grad_norms: VecDeque<f64>,
}

impl LossHistory {
    /// Returns the anomaly of a step, checked before its update.
    pub fn anomaly(&self, loss: f64, grad_norm: f64, optimizer: &OptimizerConfig) -> Option<StepAnomaly> {
        if !(loss.is_finite() && grad_norm.is_finite()) {
            return Some(StepAnomaly::NotFinite);
        }
        let factor = optimizer.spike_factor;
        let is_spike = |value: f64, median: Option<f64>| factor > 0.0 && median.is_some_and(|m| value > factor * m);
        let [median_loss, median_grad_norm] = self.medians();
        if is_spike(loss, median_loss) {
            return Some(StepAnomaly::LossSpike);
        }
        is_spike(grad_norm, median_grad_norm).then_some(StepAnomaly::GradNormSpike)
    }

    /// Adds a good step. Skipped steps are not added, since they would raise the medians.
    pub fn push(&mut self, loss: f64, grad_norm: f64) {
        for (window, value) in [(&mut self.losses, loss), (&mut self.grad_norms, grad_norm)] {
            if window.len() == WINDOW {
                window.pop_front();
            }
            window.push_back(value);
        }
    }

    /// Returns the medians of loss and gradient norm; `None` for fewer than 20 steps.
    pub fn medians(&self) -> [Option<f64>; 2] {
        [&self.losses, &self.grad_norms]
            .map(|window| (window.len() >= MIN_STEPS).then(|| median(&window.iter().copied().collect::<Vec<_>>())))
    }
}

/// A line of `bad_steps.jsonl`. NaN and infinity are written as `null`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SkippedStep {
    /// The skipped step, from 1.
    pub step: u64,
    pub stage: Stage,
    pub reason: StepAnomaly,
    pub loss: Option<f64>,
    /// Global norm of the gradient before clipping.
    pub grad_norm: Option<f64>,
    /// Median loss of the good steps before; `null` for fewer than 20 steps.
    pub median_loss: Option<f64>,
    /// Median gradient norm of the good steps before.
    pub median_grad_norm: Option<f64>,
    /// Number of consecutive skipped steps, including this one.
    pub in_a_row: u32,
    pub scenes: Vec<SkippedStepScene>,
}

#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct SkippedStepScene {
    pub key: String,
    /// Frames of the contexts.
    pub context: Vec<usize>,
    /// Frames of the targets.
    pub target: Vec<usize>,
}

/// The scenes of a whole batch for the logs, in the order of slots.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BatchScenes {
    pub scenes: Vec<SkippedStepScene>,
    /// Scenes that were skipped while the batch was filled.
    pub skipped: Vec<SkippedScene>,
}

impl BatchScenes {
    /// Joins the scenes of all ranks. `batch` has those of this rank's slots.
    pub fn gather(batch: &StageBatch, parts: BatchParts, ranks: &Ranks) -> Result<Self, TrainError> {
        let scene = |clip: &Clip| SkippedStepScene {
            key: clip.key.clone(),
            context: clip.context.frame_index.clone(),
            target: clip.target.frame_index.clone(),
        };
        let scenes: Vec<_> = parts.slots().zip(batch.clips.iter().map(scene)).collect();
        let (scenes, skipped): (Vec<_>, Vec<_>) = ranks.gather((scenes, batch.skipped.clone()))?.into_iter().unzip();
        Ok(Self { scenes: in_order(scenes), skipped: in_order(skipped) })
    }
}

/// Joins the items of all ranks in the order of slots.
fn in_order<T>(items: Vec<Vec<(usize, T)>>) -> Vec<T> {
    let mut items: Vec<_> = items.into_iter().flatten().collect();
    items.sort_by_key(|(slot, _)| *slot);
    items.into_iter().map(|(_, item)| item).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn anomalies_are_values_that_are_not_finite_and_spikes_above_the_median() {
        let mut recent = LossHistory::default();
        let anomaly = |recent: &LossHistory, loss, norm, spike_factor| {
            recent.anomaly(loss, norm, &OptimizerConfig { spike_factor, ..OptimizerConfig::default() })
        };
        for (loss, norm) in [(f64::NAN, 1.0), (1.0, f64::INFINITY), (f64::NEG_INFINITY, f64::NAN)] {
            assert_eq!(anomaly(&recent, loss, norm, 0.0), Some(StepAnomaly::NotFinite));
        }
        (1..=19).for_each(|_| recent.push(1.0, 1.0));
        assert_eq!(recent.medians(), [None; 2]);
        assert_eq!(anomaly(&recent, 1e300, 1e300, 2.0), None, "without a median there are no spikes");
        (1..=101).for_each(|i| recent.push(f64::from(i), 2.0 * f64::from(i)));
        assert_eq!(recent.medians(), [Some(51.0), Some(102.0)], "the earlier steps are forgotten");
        assert_eq!(anomaly(&recent, 153.0, 306.0, 3.0), None, "exactly the factor");
        assert_eq!(anomaly(&recent, 153.1, 306.0, 3.0), Some(StepAnomaly::LossSpike));
        assert_eq!(anomaly(&recent, 153.0, 306.1, 3.0), Some(StepAnomaly::GradNormSpike));
        assert_eq!(anomaly(&recent, 1e30, 1e30, 0.0), None, "0 looks for none");
    }
}
