//! Holds a time per frame while the camera moves: fewer tokens first, then a lower JPEG quality, then smaller frames.

/// JPEG qualities, from the best.
pub const QUALITIES: [u8; 4] = [90, 75, 60, 45];
/// Steps of the number of tokens, each 3/4 of the one before: down to 13 %.
const TOKEN_STEPS: usize = 7;
const TOKEN_FACTOR: f64 = 0.75;
/// Share of the budget below which a frame counts as fast.
const FAST: f64 = 0.6;
/// Fast frames before the quality is raised by a step.
const PATIENCE: u32 = 12;

/// The reductions in force for a client.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FrameBudget {
    level: usize,
    num_fast: u32,
}

/// Settings of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FrameSettings {
    pub tokens: usize,
    pub quality: u8,
    /// Position in the ascending list of sizes.
    pub size: usize,
}

impl FrameBudget {
    /// Returns the settings of the next frame for the wanted `tokens` and `size`.
    pub fn settings(self, tokens: usize, size: usize) -> FrameSettings {
        let token_steps = self.level.min(TOKEN_STEPS);
        let quality_steps = (self.level - token_steps).min(QUALITIES.len() - 1);
        let size_steps = self.level - token_steps - quality_steps;
        FrameSettings {
            tokens: ((tokens as f64 * TOKEN_FACTOR.powi(token_steps as i32)) as usize).clamp(1, tokens.max(1)),
            quality: QUALITIES[quality_steps],
            size: size.saturating_sub(size_steps),
        }
    }

    /// Records that a frame took `seconds`; the next frames have other settings if it does not fit `budget_s`.
    ///
    /// `size` is the wanted position in the list of sizes.
    pub fn record(&mut self, seconds: f64, budget_s: f64, size: usize) {
        let lowest = TOKEN_STEPS + QUALITIES.len() - 1 + size;
        if seconds > budget_s {
            let steps = if seconds > 1.5 * budget_s { 2 } else { 1 };
            *self = Self { level: (self.level + steps).min(lowest), num_fast: 0 };
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
    fn tokens_fall_first_then_quality_then_size() {
        let mut budget = FrameBudget::default();
        let mut seen = vec![budget.settings(256, 2)];
        for _ in 0..20 {
            budget.record(0.04, 0.03, 2);
            seen.push(budget.settings(256, 2));
        }
        assert_eq!(seen[0], FrameSettings { tokens: 256, quality: 90, size: 2 });
        assert_eq!(seen[1], FrameSettings { tokens: 192, quality: 90, size: 2 });
        assert_eq!(seen[7], FrameSettings { tokens: 34, quality: 90, size: 2 });
        assert_eq!(seen[8], FrameSettings { tokens: 34, quality: 75, size: 2 });
        assert_eq!(seen[10], FrameSettings { tokens: 34, quality: 45, size: 2 });
        assert_eq!(seen[11], FrameSettings { tokens: 34, quality: 45, size: 1 });
        assert_eq!(seen[20], FrameSettings { tokens: 34, quality: 45, size: 0 });
        assert_eq!(budget.settings(1, 0).tokens, 1);
    }

    #[test]
    fn fast_frames_restore_the_settings_and_fitting_ones_keep_them() {
        let mut budget = FrameBudget::default();
        budget.record(0.1, 0.03, 1);
        let reduced = budget;
        assert_eq!(budget.settings(256, 1).tokens, 144, "two steps");
        for _ in 0..100 {
            budget.record(0.025, 0.03, 1);
        }
        assert_eq!(budget.settings(256, 1), reduced.settings(256, 1));
        for _ in 0..2 * PATIENCE {
            budget.record(0.01, 0.03, 1);
        }
        assert_eq!(budget.settings(256, 1), FrameSettings { tokens: 256, quality: 90, size: 1 });
    }
}
