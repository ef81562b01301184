//! Time per frame against the number of rendered tokens, measured on a device.

use std::time::Instant;

use clift_core::{Camera, median};
use clift_model::ModelError;

use crate::scene::scene_renderer::SceneRenderer;

/// Timed shares of the storage tokens, in sixteenths, besides all tokens.
const SIXTEENTHS: [usize; 5] = [1, 2, 4, 8, 12];
/// Most timed repetitions of one token count.
const MAX_REPETITIONS: usize = 7;
/// Seconds after which two repetitions are enough.
const ENOUGH_S: f64 = 1.0;

/// Measured times per frame, from token selection to pixels on the host.
#[derive(Clone, Debug, PartialEq)]
pub struct RenderBudget {
    /// Number of tokens and seconds per frame, for subsets of the tokens in ascending order.
    pub some: Vec<(usize, f64)>,
    /// Number of all tokens and seconds per frame, without selection and with several frames per call.
    pub all: (usize, f64),
}

impl RenderBudget {
    /// Measures the time per frame for a few token counts.
    pub fn measure(
        renderer: &mut SceneRenderer,
        view: &Camera,
        height: usize,
        width: usize,
    ) -> Result<Self, ModelError> {
        let num_storage_tokens = renderer.max_render_tokens();
        let mut counts: Vec<usize> = SIXTEENTHS
            .iter()
            .map(|part| (num_storage_tokens * part / 16).max(1))
            .chain([num_storage_tokens - 1])
            .collect();
        counts.retain(|&count| count > 0 && count < num_storage_tokens);
        counts.dedup();
        let mut some = Vec::new();
        for count in counts {
            some.push((count, median_s(renderer, &[*view], height, width, count)?));
        }
        let views = vec![*view; renderer.frames_per_call(height, width)];
        let all = (num_storage_tokens, median_s(renderer, &views, height, width, num_storage_tokens)?);
        renderer.reset();
        Ok(Self { some, all })
    }

    /// Returns the largest number of tokens whose frames take at most `budget_s` seconds; `None` if the smallest measured
    /// number takes longer.
    ///
    /// Time is interpolated linearly between measured numbers. A number that was measured slower than a larger one counts
    /// as fast as the larger one, because the difference is noise.
    pub fn most_tokens(&self, budget_s: f64) -> Option<usize> {
        if self.all.1 <= budget_s {
            return Some(self.all.0);
        }
        let mut times = self.some.clone();
        for i in (1..times.len()).rev() {
            times[i - 1].1 = times[i - 1].1.min(times[i].1);
        }
        let mut best = None;
        let mut before: Option<(usize, f64)> = None;
        for (count, seconds) in times {
            if seconds <= budget_s {
                best = Some(count);
            } else {
                let (fewer, earlier) = before?;
                let share = (budget_s - earlier) / (seconds - earlier);
                // 1e-9 keeps a rounding error from truncating a whole number to the number below.
                return Some(fewer + ((count - fewer) as f64 * share + 1e-9) as usize);
            }
            before = Some((count, seconds));
        }
        best
    }

    /// Returns the shortest measured time per frame in seconds.
    pub fn least_s(&self) -> f64 {
        self.some.iter().chain([&self.all]).map(|(_, seconds)| *seconds).fold(f64::INFINITY, f64::min)
    }
}

/// Measures the median seconds per frame after one warm-up call.
fn median_s(
    renderer: &mut SceneRenderer,
    views: &[Camera],
    height: usize,
    width: usize,
    count: usize,
) -> Result<f64, ModelError> {
    renderer.render(views, height, width, count)?;
    let mut seconds = Vec::new();
    let started = Instant::now();
    while seconds.len() < 2 || (seconds.len() < MAX_REPETITIONS && started.elapsed().as_secs_f64() < ENOUGH_S) {
        let now = Instant::now();
        renderer.render(views, height, width, count)?;
        seconds.push(now.elapsed().as_secs_f64() / views.len() as f64);
    }
    Ok(median(&seconds))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn most_tokens_interpolates_measured_times() {
        let plain = RenderBudget { some: vec![(16, 0.010), (64, 0.022), (128, 0.030)], all: (256, 0.050) };
        // 64 tokens took 12 ms, so that 16 tokens count as fast.
        let noisy = RenderBudget { some: vec![(8, 0.010), (16, 0.020), (64, 0.012), (128, 0.030)], all: (256, 0.050) };
        let first = RenderBudget { some: vec![(1, 0.0019), (2, 0.0015), (4, 0.0016)], all: (16, 0.0017) };
        // Several frames of all tokens per call are cheaper than single frames of some.
        let all = RenderBudget { some: vec![(16, 0.010), (64, 0.012)], all: (256, 0.008) };
        let one = RenderBudget { some: Vec::new(), all: (1, 0.01) };
        for (times, budget_s, expected) in [
            (&plain, 0.009, None),
            (&plain, 0.010, Some(16)),
            (&plain, 0.016, Some(40)),
            (&plain, 0.0219, Some(63)),
            (&plain, 0.030, Some(128)),
            (&plain, 0.049, Some(128)),
            (&plain, 0.050, Some(256)),
            (&noisy, 0.011, Some(12)),
            (&noisy, 0.012, Some(64)),
            (&noisy, 0.021, Some(96)),
            (&first, first.least_s(), Some(2)),
            (&all, 0.009, Some(256)),
            (&one, 0.02, Some(1)),
            (&one, 0.001, None),
        ] {
            assert_eq!(times.most_tokens(budget_s), expected, "{budget_s}");
        }
        assert_eq!([&plain, &first, &all].map(RenderBudget::least_s), [0.010, 0.0015, 0.008]);
        let counts = (0..100).map(|step| noisy.most_tokens(0.0006 * f64::from(step)).unwrap_or(0));
        assert!(counts.is_sorted(), "a larger budget never allows fewer tokens");
    }
}
