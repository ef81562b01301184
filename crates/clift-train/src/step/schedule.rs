//! Learning rate of each step.

use crate::config::config::{OptimizerConfig, Schedule};

/// Learning rate at the start of the warm-up.
const START: f64 = 1e-8;

/// Share of the steps in which [`Schedule::Wsd`] lowers the rate.
const DECAY_SHARE: f64 = 0.5;

/// Returns the learning rate of `step` = 1, 2, ..: linear from 1e-8 to `optimizer.learning_rate` during the warm-up, then by
/// the schedule down to 0 at `num_steps` and later.
pub fn learning_rate(optimizer: &OptimizerConfig, step: u64, num_steps: u64) -> f64 {
    let OptimizerConfig { learning_rate: base, warm_up_steps, schedule, .. } = *optimizer;
    let is_warm_up = step <= warm_up_steps;
    let risen = if is_warm_up { START + (base - START) * step as f64 / warm_up_steps as f64 } else { base };
    match schedule {
        Schedule::Cosine if is_warm_up => risen,
        Schedule::Cosine => {
            let num_decay_steps = num_steps.saturating_sub(warm_up_steps).max(1) as f64;
            let progress = ((step - warm_up_steps) as f64 / num_decay_steps).min(1.0);
            base * 0.5 * (1.0 + (std::f64::consts::PI * progress).cos())
        }
        Schedule::Wsd => {
            let num_decay_steps = (DECAY_SHARE * num_steps as f64).max(1.0);
            // A warm-up of more than half of the steps ends where it meets the fall.
            risen.min(base * (num_steps.saturating_sub(step) as f64 / num_decay_steps).min(1.0))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::Reference;

    fn rate(schedule: Schedule, step: u64, learning_rate: f64, warm_up_steps: u64, num_steps: u64) -> f64 {
        let optimizer = OptimizerConfig { schedule, learning_rate, warm_up_steps, ..OptimizerConfig::default() };
        super::learning_rate(&optimizer, step, num_steps)
    }

    #[test]
    fn rates_equal_those_of_pytorch() {
        for (step, expected) in (1..).zip(Reference::open("reference/adamw").values("output.lr")) {
            let rate = rate(Schedule::Cosine, step, 1e-3, 3, 10);
            // The same formula in f64; the two cosines may differ in the last bit, 1e-16 of 1e-3.
            assert!((rate - expected).abs() < 1e-18, "step {step}: {rate} is not {expected}");
        }
    }

    #[test]
    fn rates_after_the_last_step_and_of_short_runs() {
        let cosine = |step, warm_up_steps, num_steps| rate(Schedule::Cosine, step, 1e-3, warm_up_steps, num_steps);
        assert_eq!(cosine(90_001, 2500, 90_000), cosine(90_000, 2500, 90_000));
        assert!(cosine(1, 0, 30) < 1e-3 && cosine(30, 100, 30) < 1e-3 && cosine(101, 100, 30).is_finite());
    }

    #[test]
    fn wsd_is_constant_and_then_linear_to_zero() {
        let rates = [1, 10, 20, 50, 60, 75, 99, 100, 101].map(|step| rate(Schedule::Wsd, step, 2e-3, 20, 100));
        let expected = [1e-4, 1e-3, 2e-3, 2e-3, 1.6e-3, 1e-3, 4e-5, 0.0, 0.0];
        for (rate, expected) in rates.into_iter().zip(expected) {
            assert!((rate - expected).abs() < 1e-8, "{rate} is not {expected}");
        }
        assert!(rate(Schedule::Wsd, 1, 1e-3, 0, 1).abs() < 1e-20);
        // Of a warm-up of more than half of the steps, without a jump.
        for (step, expected) in [(60, 0.75), (70, 0.6), (80, 0.4), (81, 0.38)] {
            let rate = rate(Schedule::Wsd, step, 1.0, 80, 100);
            assert!((rate - expected).abs() < 1e-7, "{rate} is not {expected}");
        }
    }
}
