//! Loss scaling of training with f16 products: gradients are computed of the loss times a power of two, so that the
//! operands of their products do not vanish in f16, and divided by it in f32 before the update.

use clift_model::Precision;
use serde::{Deserialize, Serialize};

/// At the start: as PyTorch's `GradScaler` has it.
const FIRST: f64 = 65_536.0;
/// Updates without overflow before the factor is doubled, likewise.
const PATIENCE: u32 = 2000;
/// Squares of gradients times this are summed in f32.
const MOST: f64 = 4_294_967_296.0;

/// The factor of the loss now: doubled after many good steps, halved by an overflow. Part of a checkpoint.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LossScale {
    /// A power of two, so that scaling rounds nothing.
    factor: f64,
    /// Good steps since it changed.
    good_steps: u32,
}

impl LossScale {
    /// The one to start with; none in f32.
    pub fn of(precision: Precision) -> Option<Self> {
        (precision == Precision::F16).then_some(Self { factor: FIRST, good_steps: 0 })
    }

    /// What the loss is multiplied by.
    pub fn factor(&self) -> f64 {
        self.factor
    }

    /// Whether it can be one: a file may hold anything.
    pub fn is_possible(&self) -> bool {
        (1.0..=MOST).contains(&self.factor) && self.factor.log2().fract() == 0.0
    }

    /// Whether a step without a finite gradient is the factor's fault, which a smaller one mends: not where the loss
    /// itself is not finite, nor once there is nothing left to halve.
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
    use super::*;

    #[test]
    fn the_factor_grows_with_patience_and_shrinks_at_once() {
        assert_eq!(LossScale::of(Precision::F32), None);
        let mut scale = LossScale::of(Precision::F16).unwrap();
        for _ in 0..PATIENCE - 1 {
            scale.grow();
        }
        assert_eq!(scale.factor(), FIRST);
        scale.grow();
        assert_eq!(scale.factor(), 2.0 * FIRST);
        scale.grow();
        scale.shrink();
        assert_eq!(scale, LossScale { factor: FIRST, good_steps: 0 }, "patience starts anew");
        for _ in 0..40 * PATIENCE {
            scale.grow();
        }
        assert_eq!(scale.factor(), MOST);
    }

    #[test]
    fn a_factor_out_of_a_file_is_a_power_of_two_within_bounds() {
        let is_possible = |factor| LossScale { factor, good_steps: 0 }.is_possible();
        assert!([1.0, 2.0, FIRST, MOST].into_iter().all(is_possible));
        assert!(![0.0, -2.0, 0.5, 3.0, 2.0 * MOST, f64::INFINITY, f64::NAN].into_iter().any(is_possible));
    }

    #[test]
    fn an_overflow_is_of_the_gradient_alone_and_ends_at_one() {
        let mut scale = LossScale::of(Precision::F16).unwrap();
        assert!(scale.is_overflow(0.1, f64::INFINITY) && scale.is_overflow(0.1, f64::NAN));
        assert!(!scale.is_overflow(f64::NAN, f64::NAN), "the batch is bad");
        assert!(!scale.is_overflow(0.1, 3.0));
        for _ in 0..16 {
            scale.shrink();
        }
        assert_eq!(scale.factor(), 1.0);
        assert!(!scale.is_overflow(0.1, f64::NAN), "no factor is to blame");
        scale.shrink();
        assert_eq!(scale.factor(), 1.0);
    }

    #[test]
    fn overflows_change_the_factor_alone_until_the_gradient_is_that_of_f32() {
        use crate::config::config::OptimizerConfig;
        use crate::step::seeded_inputs::{Shape, seeded_batch, seeded_model};
        use crate::step::train_state::TrainState;

        let device = burn::tensor::Device::flex();
        let sizes = clift_model::ModelConfig {
            dim: 16,
            num_heads: 2,
            feed_forward_dim: 24,
            num_encoder_blocks: 1,
            num_renderer_blocks: 1,
            ..clift_model::ModelConfig::default()
        };
        let batch = seeded_batch(Shape { num_context: 2, num_targets: 2, size: [16, 16] }, 2, 8, None, 1).unwrap();
        for activation_checkpointing in [false, true] {
            let learner = |loss_scale| TrainState {
                model: crate::run::stage_plan::freeze(crate::events::Stage::Stage1, seeded_model(&sizes, 3, &device)),
                optimizer: crate::step::optimizer::adamw(&OptimizerConfig::default()),
                device: device.clone().autodiff(),
                loss: crate::step::loss::Loss::default(),
                activation_checkpointing,
                loss_scale,
            };
            let (_, expected) = learner(None).step(&batch, 1, 1e-4.into(), 1.0).unwrap();
            let hash = |learner: &TrainState| clift_model::weights_hash(&learner.model);
            let mut half = learner(Some(LossScale { factor: MOST, good_steps: 7 }));
            let start = hash(&half);
            let mut num_overflows = 0;
            let update = loop {
                let update;
                (half, update) = half.step(&batch, 2, 1e-4.into(), 1.0).unwrap();
                if !half.adapt_loss_scale(&update) {
                    break update;
                }
                assert!(!update.applied && hash(&half) == start);
                num_overflows += 1;
            };
            assert!(num_overflows > 0 && num_overflows < 30, "{num_overflows}");
            assert!(update.applied && hash(&half) != start);
            let factor = MOST / f64::from(1 << num_overflows);
            assert_eq!(half.loss_scale, Some(LossScale { factor, good_steps: 1 }));
            let apart = (update.grad_norm / expected.grad_norm - 1.0).abs();
            assert!(apart < 0.01, "{} for {}", update.grad_norm, expected.grad_norm);
        }
    }
}
