//! Time per frame against the number of rendered tokens, measured on a device: what a budget in milliseconds buys.

use std::time::Instant;

use crate::error::ModelError;
use crate::scene::scene_renderer::SceneRenderer;
use crate::views::camera::ViewCamera;

/// Parts of the stored tokens that are timed, in sixteenths; all of them are timed beside.
const SIXTEENTHS: [usize; 5] = [1, 2, 4, 8, 12];

/// Draws of one count, after one that is not timed: at least two, at most so many, and no more after so many seconds.
const MAX_DRAWS: usize = 7;
const ENOUGH_S: f64 = 1.0;

/// Time per frame, from the choice of tokens to pixels on the host.
#[derive(Clone, Debug, PartialEq)]
pub struct RenderBudget {
    /// Tokens and seconds, by tokens: what was measured of frames drawn from a part of the tokens.
    pub some: Vec<(usize, f64)>,
    /// All tokens and seconds, where frames are drawn several at a time and tokens need no choosing.
    pub all: (usize, f64),
}

impl RenderBudget {
    /// Times frames of a few counts.
    ///
    /// # Errors
    /// As [`SceneRenderer::draw`].
    pub fn measure(
        viewer: &mut SceneRenderer,
        view: &ViewCamera,
        height: usize,
        width: usize,
    ) -> Result<Self, ModelError> {
        let num_storage_tokens = viewer.num_storage_tokens();
        let mut counts: Vec<usize> = SIXTEENTHS
            .iter()
            .map(|part| (num_storage_tokens * part / 16).max(1))
            .chain([num_storage_tokens - 1])
            .collect();
        counts.retain(|&count| count > 0 && count < num_storage_tokens);
        counts.dedup();
        let mut some = Vec::new();
        for count in counts {
            some.push((count, median_s(viewer, &[*view], height, width, count)?));
        }
        let views = vec![*view; viewer.frames_per_call(height, width)];
        let all = (num_storage_tokens, median_s(viewer, &views, height, width, num_storage_tokens)?);
        viewer.reset();
        Ok(Self { some, all })
    }

    /// The most tokens whose frames take at most `budget_s` seconds; `None` if not even the fewest that were timed do.
    ///
    /// Between measured counts time is a straight line, and fewer tokens never take more time than more do: what an
    /// earlier count seems to cost beyond that is the machine's doing.
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
                // The small excess keeps a whole number from being rounded down to the one before.
                return Some(fewer + ((count - fewer) as f64 * share + 1e-9) as usize);
            }
            before = Some((count, seconds));
        }
        best
    }

    /// The shortest time that was measured.
    pub fn least_s(&self) -> f64 {
        self.some.iter().chain([&self.all]).map(|(_, seconds)| *seconds).fold(f64::INFINITY, f64::min)
    }
}

/// Median seconds per frame.
fn median_s(
    viewer: &mut SceneRenderer,
    views: &[ViewCamera],
    height: usize,
    width: usize,
    count: usize,
) -> Result<f64, ModelError> {
    viewer.draw(views, height, width, count)?;
    let mut seconds = Vec::new();
    let started = Instant::now();
    while seconds.len() < 2 || (seconds.len() < MAX_DRAWS && started.elapsed().as_secs_f64() < ENOUGH_S) {
        let now = Instant::now();
        viewer.draw(views, height, width, count)?;
        seconds.push(now.elapsed().as_secs_f64() / views.len() as f64);
    }
    seconds.sort_by(f64::total_cmp);
    Ok(seconds[seconds.len() / 2])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_budget_between_two_measured_counts_buys_its_share_of_the_tokens_between() {
        let times = RenderBudget { some: vec![(16, 0.010), (64, 0.022), (128, 0.030)], all: (256, 0.050) };
        for (budget_s, expected) in [
            (0.009, None),
            (0.010, Some(16)),
            (0.016, Some(40)),
            (0.0219, Some(63)),
            (0.030, Some(128)),
            (0.049, Some(128)),
            (0.050, Some(256)),
        ] {
            assert_eq!(times.most_tokens(budget_s), expected, "{budget_s}");
        }
        assert_eq!(times.least_s(), 0.010);
    }

    #[test]
    fn a_count_that_was_slow_by_chance_hides_no_larger_one_that_fits() {
        // 64 tokens took 12 ms, so that 16 take no more, whatever the clock said then.
        let times = RenderBudget { some: vec![(8, 0.010), (16, 0.020), (64, 0.012), (128, 0.030)], all: (256, 0.050) };
        assert_eq!(times.most_tokens(0.011), Some(12));
        assert_eq!(times.most_tokens(0.012), Some(64));
        assert_eq!(times.most_tokens(0.021), Some(96));
        // The shortest time that is named can be had, wherever it was measured.
        let first = RenderBudget { some: vec![(1, 0.0019), (2, 0.0015), (4, 0.0016)], all: (16, 0.0017) };
        assert_eq!(first.most_tokens(first.least_s()), Some(2));
        let mut last = 0;
        for step in 0..100 {
            let count = times.most_tokens(0.0006 * f64::from(step)).unwrap_or(0);
            assert!(count >= last, "a larger budget never buys fewer");
            last = count;
        }
    }

    #[test]
    fn all_tokens_are_taken_where_drawing_several_frames_at_once_makes_them_cheaper_than_some() {
        let times = RenderBudget { some: vec![(16, 0.010), (64, 0.012)], all: (256, 0.008) };
        assert_eq!(times.most_tokens(0.009), Some(256));
        assert_eq!(times.least_s(), 0.008);
        let one = RenderBudget { some: Vec::new(), all: (1, 0.01) };
        assert_eq!((one.most_tokens(0.02), one.most_tokens(0.001)), (Some(1), None));
    }
}
