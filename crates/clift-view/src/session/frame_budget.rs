//! Holds a time per frame while the camera moves: fewer tokens first, then smaller frames, down to the trained size.

/// Steps of the number of tokens, each 3/4 of the one before: down to 13 %.
const TOKEN_STEPS: usize = 7;
const TOKEN_FACTOR: f64 = 0.75;
/// Share of the budget below which a frame counts as fast.
const FAST: f64 = 0.6;
/// Fast frames before the settings are raised by a step.
const PATIENCE: u32 = 12;

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FrameBudget {
    level: usize,
    num_fast: u32,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FrameSettings {
    pub tokens: usize,
    /// Position in the ascending list of sizes.
    pub size: usize,
}

impl FrameBudget {
    pub fn reduce(self, wanted: FrameSettings) -> FrameSettings {
        let token_steps = self.level.min(TOKEN_STEPS);
        let tokens = (wanted.tokens as f64 * TOKEN_FACTOR.powi(token_steps as i32)) as usize;
        FrameSettings {
            tokens: tokens.clamp(1, wanted.tokens.max(1)),
            size: wanted.size.saturating_sub(self.level - token_steps),
        }
    }

    /// Records that a frame took `seconds`; the next frames have other settings if it does not fit `budget_s`.
    pub fn record(&mut self, seconds: f64, budget_s: f64, wanted: FrameSettings) {
        if seconds > budget_s {
            let steps = if seconds > 1.5 * budget_s { 2 } else { 1 };
            *self = Self { level: (self.level + steps).min(TOKEN_STEPS + wanted.size), num_fast: 0 };
        } else if seconds < FAST * budget_s {
            self.num_fast += 1;
            if self.num_fast >= PATIENCE {
                *self = Self { level: self.level.saturating_sub(1), num_fast: 0 };
            }
        } else {
            self.num_fast = 0;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tokens_fall_first_then_size_and_fast_frames_in_a_row_restore_both() {
        let wanted = FrameSettings { tokens: 256, size: 2 };
        let mut budget = FrameBudget::default();
        let mut seen = vec![budget.reduce(wanted)];
        for _ in 0..20 {
            budget.record(0.04, 0.03, wanted);
            seen.push(budget.reduce(wanted));
        }
        let at = |i: usize| (seen[i].tokens, seen[i].size);
        assert_eq!([0, 1, 7, 8, 20].map(at), [(256, 2), (192, 2), (34, 2), (34, 1), (34, 0)]);
        assert_eq!(budget.reduce(FrameSettings { tokens: 1, size: 0 }).tokens, 1);
        (0..100).for_each(|_| budget.record(0.025, 0.03, wanted));
        assert_eq!(budget.reduce(wanted), seen[20], "frames that fit keep the settings");
        (0..9 * PATIENCE).for_each(|_| budget.record(0.01, 0.03, wanted));
        assert_eq!(budget.reduce(wanted), wanted);
        budget.record(0.1, 0.03, wanted);
        let reduced = budget.reduce(wanted);
        assert_eq!(reduced.tokens, 144, "two steps");
        for _ in 0..4 {
            (1..PATIENCE).for_each(|_| budget.record(0.01, 0.03, wanted));
            budget.record(0.025, 0.03, wanted);
        }
        assert_eq!(budget.reduce(wanted), reduced, "fast frames that are not in a row");
    }
}
