//! Loss scaling for training with f16 products: the loss is multiplied by a power of two, so that gradients do not underflow
//! in f16, and the gradients are divided by this factor in f32 before the update.

use clift_model::Precision;
use serde::{Deserialize, Serialize};

/// Initial factor, as in PyTorch's `GradScaler`.
const FIRST: f64 = 65_536.0;
/// Updates without overflow before the factor is doubled, as in PyTorch.
const PATIENCE: u32 = 2000;
/// Largest factor: squares of scaled gradients are summed in f32.
const MOST: f64 = 4_294_967_296.0;

/// Factor of the loss: doubled after many good steps, halved after an overflow. Part of a checkpoint.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LossScale {
    /// A power of two: scaling does not round.
    factor: f64,
    /// Good steps since the last change.
    good_steps: u32,
}

impl LossScale {
    /// Returns the initial loss scale of a precision; `None` for f32 and bf16, which have the same range.
    pub fn of(precision: Precision) -> Option<Self> {
        (precision == Precision::F16).then_some(Self { factor: FIRST, good_steps: 0 })
    }

    /// Returns the factor of the loss.
    pub fn factor(&self) -> f64 {
        self.factor
    }

    /// Whether the factor, read from a file, is valid.
    pub fn is_possible(&self) -> bool {
        (1.0..=MOST).contains(&self.factor) && self.factor.log2().fract() == 0.0
    }

    /// Whether a step has a finite loss but no finite gradient, and the factor can still be halved.
    pub fn is_overflow(&self, loss: f64, grad_norm: f64) -> bool {
        loss.is_finite() && !grad_norm.is_finite() && self.factor > 1.0
    }

    /// Halves the factor.
    pub fn shrink(&mut self) {
        *self = Self { factor: (self.factor / 2.0).max(1.0), good_steps: 0 };
    }

    /// Counts a good step.
    pub fn grow(&mut self) {
        self.good_steps += 1;
        if self.good_steps >= PATIENCE {
            *self = Self { factor: (self.factor * 2.0).min(MOST), good_steps: 0 };
        }
    }
}

#[cfg(test)]
mod tests {
    use clift_model::{ModelConfig, weights_hash};

    use super::*;
    use crate::config::config::OptimizerConfig;
    use crate::events::Stage;
    use crate::stage::settings::freeze;
    use crate::step::seeded_inputs::{ClipShape, seeded_batch, seeded_model};
    use crate::step::train_state::TrainState;

    #[test]
    fn factor_grows_slowly_and_shrinks_at_once() {
        let mut scale = LossScale::of(Precision::F16).unwrap();
        (1..PATIENCE).for_each(|_| scale.grow());
        assert_eq!(scale.factor(), FIRST);
        scale.grow();
        assert_eq!(scale.factor(), 2.0 * FIRST);
        scale.grow();
        scale.shrink();
        assert_eq!(scale, LossScale { factor: FIRST, good_steps: 0 }, "the count restarts");
        let mut most = LossScale { factor: MOST, good_steps: PATIENCE - 1 };
        most.grow();
        assert_eq!(most.factor(), MOST);
        assert!(scale.is_overflow(0.1, f64::INFINITY) && scale.is_overflow(0.1, f64::NAN));
        assert!(!scale.is_overflow(f64::NAN, f64::NAN), "the batch is bad");
        assert!(!scale.is_overflow(0.1, 3.0));
        let mut least = LossScale { factor: 1.0, good_steps: 0 };
        assert!(!least.is_overflow(0.1, f64::NAN), "the factor is 1");
        least.shrink();
        assert_eq!(least.factor(), 1.0);
        let is_possible = |factor| LossScale { factor, good_steps: 0 }.is_possible();
        assert!([1.0, 2.0, FIRST, MOST].into_iter().all(is_possible));
        assert!(![0.0, -2.0, 0.5, 3.0, 2.0 * MOST, f64::INFINITY, f64::NAN].into_iter().any(is_possible));
    }

    #[test]
    fn overflows_change_only_the_factor() {
        let device = burn::tensor::Device::flex();
        let batch = seeded_batch(ClipShape { num_context: 2, num_targets: 2, size: [16, 16] }, 2, None, 1).unwrap();
        let new_state = |precision: Precision, loss_scale: Option<LossScale>| {
            let model = freeze(Stage::Stage1, seeded_model(&ModelConfig::small(), 3, &device));
            let plain = TrainState::new(model, &OptimizerConfig::default(), device.clone().autodiff());
            TrainState { precision, loss_scale, ..plain }
        };
        let (_, expected) = new_state(Precision::F32, None).step(&batch, 1, 1e-4.into(), 1.0).unwrap();
        let mut scaled = new_state(Precision::F16, Some(LossScale { factor: MOST, good_steps: 7 }));
        let start = weights_hash(&scaled.model);
        let mut num_overflows = 0;
        let update = loop {
            let update;
            (scaled, update) = scaled.step(&batch, 2, 1e-4.into(), 1.0).unwrap();
            if !scaled.adapt_loss_scale(&update) {
                break update;
            }
            assert!(!update.applied && weights_hash(&scaled.model) == start);
            num_overflows += 1;
        };
        assert!(num_overflows > 0 && num_overflows < 30, "{num_overflows}");
        assert!(update.applied && weights_hash(&scaled.model) != start);
        let factor = MOST / f64::from(1 << num_overflows);
        assert_eq!(scaled.loss_scale, Some(LossScale { factor, good_steps: 1 }));
        let difference = (update.grad_norm / expected.grad_norm - 1.0).abs();
        assert!(difference < 0.01, "{} for {}", update.grad_norm, expected.grad_norm);
    }
}
