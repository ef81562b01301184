//! Learning rate of each step.

/// Learning rate at the start of the warm-up.
const START: f64 = 1e-8;

/// Returns the learning rate of `step` = 1, 2, ..: linear from 1e-8 to `base` during the warm-up, then half a cosine down to
/// 0 at `num_steps` and later.
pub fn warm_up_cosine(step: u64, base: f64, num_warm_up_steps: u64, num_steps: u64) -> f64 {
    if step <= num_warm_up_steps {
        return START + (base - START) * step as f64 / num_warm_up_steps as f64;
    }
    let num_decay_steps = num_steps.saturating_sub(num_warm_up_steps).max(1) as f64;
    let progress = ((step - num_warm_up_steps) as f64 / num_decay_steps).min(1.0);
    base * 0.5 * (1.0 + (std::f64::consts::PI * progress).cos())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::Reference;

    #[test]
    fn rates_equal_those_of_pytorch() {
        for (step, expected) in (1..).zip(Reference::open("reference/adamw").values("output.lr")) {
            let rate = warm_up_cosine(step, 1e-3, 3, 10);
            // The same formula in f64; the two cosines may differ in the last bit, 1e-16 of 1e-3.
            assert!((rate - expected).abs() < 1e-18, "step {step}: {rate} is not {expected}");
        }
    }

    #[test]
    fn rates_after_the_last_step_and_of_short_runs() {
        assert_eq!(warm_up_cosine(90_001, 4e-4, 2500, 90_000), warm_up_cosine(90_000, 4e-4, 2500, 90_000));
        assert!(warm_up_cosine(1, 1e-3, 0, 30) < 1e-3 && warm_up_cosine(30, 1e-3, 100, 30) < 1e-3);
        assert!(warm_up_cosine(101, 1e-3, 100, 30).is_finite());
    }
}
