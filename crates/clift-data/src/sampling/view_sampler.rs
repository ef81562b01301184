//! Which frames of a scene become context and target views of a training item.

use rand::Rng;
use serde::{Deserialize, Serialize};

use crate::error::DataError;
use crate::random::{between, sample_from, step_rng, uniform_below};
use crate::sampling::clip::ViewIndices;
use crate::sampling::inner_views::InnerViews;
use crate::scene_source::SceneSource;

/// Most context or target views of an item.
const MAX_VIEWS: usize = 10_000;

/// Value at `step` of a number that grows linearly from `init` to `last` in `warm_up_steps` steps and then stays:
/// `min(init + trunc((last - init) * step / warm_up_steps), last)`.
///
/// Expects `init <= last`; without warm-up steps the value is `last` from the start.
pub fn linear_warm_up(init: usize, last: usize, warm_up_steps: u64, step: u64) -> usize {
    if warm_up_steps == 0 || step >= warm_up_steps {
        return last;
    }
    let growth = last.saturating_sub(init) as u128 * u128::from(step) / u128::from(warm_up_steps);
    init + growth as usize
}

/// Draws a stretch of a scene, whose two ends and some inner frames are the context, and targets from inside it.
///
/// The stretch grows during training: its gap (last minus first frame) is uniform in `[min_gap, max_gap]`, both on
/// the [`linear_warm_up`] of `warm_up_steps`. This is the `bounded_v2` sampler of DepthSplat, which the paper trains with;
/// the default is its RealEstate10K setting with the paper's 4 to 6 contexts (paper, appendix).
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ViewSampler {
    /// Fewest context views of an item; at least 2.
    pub min_context: usize,
    /// Most context views of an item. One number is drawn for each batch.
    pub max_context: usize,
    /// Smallest gap between the first and the last context frame: at step 0, and after the warm-up.
    pub min_gap: [usize; 2],
    /// Largest gap between the first and the last context frame: at step 0, and after the warm-up. A scene that
    /// is shorter lowers it, down to the smallest gap.
    pub max_gap: [usize; 2],
    /// Steps in which the gaps go from their first to their last value; 0 starts with the last.
    pub warm_up_steps: u64,
    /// Target views of an item.
    pub num_targets: usize,
    /// Whether a frame may be a target more than once. A target may be a context frame either way.
    pub with_replacement: bool,
    /// How the contexts between the two ends are chosen: `random`, `farthest_point` or `even`.
    #[serde(skip_serializing_if = "InnerViews::is_default")]
    pub inner: InnerViews,
}

impl Default for ViewSampler {
    fn default() -> Self {
        Self {
            min_context: 4,
            max_context: 6,
            min_gap: [25, 45],
            max_gap: [45, 135],
            warm_up_steps: 30_000,
            num_targets: 6,
            with_replacement: true,
            inner: InnerViews::Random,
        }
    }
}

impl ViewSampler {
    /// Checks that every draw the fields allow is possible in a scene that is long enough.
    ///
    /// # Errors
    /// [`DataError::BadConfig`] naming the first field that cannot hold.
    pub fn validate(&self) -> Result<(), DataError> {
        let fail = |key: &str, problem: String| Err(DataError::bad_config(key, problem));
        let Self { min_context, max_context, min_gap, max_gap, num_targets, .. } = self;
        if *min_context < 2 {
            return fail("min_context", format!("is {min_context}; a stretch has two ends, so use 2 or more"));
        }
        if max_context < min_context {
            return fail("max_context", format!("is {max_context}; use min_context = {min_context} or more"));
        }
        if *num_targets == 0 {
            return fail("num_targets", "is 0; use 1 or more".into());
        }
        for (key, count) in [("max_context", max_context), ("num_targets", num_targets)] {
            if *count > MAX_VIEWS {
                return fail(key, format!("is {count}; use {MAX_VIEWS} or fewer"));
            }
        }
        for (key, gap) in [("min_gap", min_gap), ("max_gap", max_gap)] {
            if gap[0] > gap[1] {
                return fail(key, format!("is {gap:?}; the second value must not be below the first"));
            }
        }
        for when in 0..2 {
            if max_gap[when] < min_gap[when] {
                return fail("max_gap", format!("is {max_gap:?}; it must not be below min_gap = {min_gap:?}"));
            }
        }
        for num_context in *min_context..=*max_context {
            let gap = min_gap[0] / self.gap_divisor(num_context);
            if gap + 1 < num_context {
                let needed = (num_context - 1) * self.gap_divisor(num_context);
                return fail(
                    "min_gap",
                    format!("is {min_gap:?}; {num_context} distinct contexts need a gap of {needed} or more"),
                );
            }
            if !self.with_replacement && gap + 1 < *num_targets {
                return fail(
                    "num_targets",
                    format!(
                        "is {num_targets}; a gap of {gap} has {} frames, so use fewer or with_replacement",
                        gap + 1
                    ),
                );
            }
        }
        Ok(())
    }

    /// Number of contexts of every item of the batch at `step`, uniform in `[min_context, max_context]`.
    pub fn num_context(&self, seed: u64, step: u64) -> usize {
        between(&mut step_rng(seed, step, "number of contexts"), self.min_context, self.max_context)
    }

    /// Smallest and largest gap at `step` of a batch with `num_context` contexts, in a scene without end.
    ///
    /// Batches with at most half of `max_context` contexts take proportionally shorter stretches.
    pub fn gap_bounds(&self, step: u64, num_context: usize) -> [usize; 2] {
        [self.min_gap, self.max_gap]
            .map(|[init, last]| linear_warm_up(init, last, self.warm_up_steps, step) / self.gap_divisor(num_context))
    }

    /// Frames of the shortest stretch of any step: no item can be drawn from a scene of fewer.
    pub fn min_frames(&self) -> usize {
        let gaps = (self.min_context..=self.max_context).map(|num_context| self.gap_bounds(0, num_context)[0]);
        gaps.min().unwrap_or(0) + 1
    }

    /// Draws the views of one item from a scene of `source`. Its cameras are read only where the choice of inner views
    /// looks at them.
    ///
    /// # Errors
    /// As [`ViewSampler::sample`], and whatever reading the scene gives.
    pub fn sample(
        &self,
        source: &dyn SceneSource,
        scene: usize,
        step: u64,
        num_context: usize,
        rng: &mut impl Rng,
    ) -> Result<ViewIndices, DataError> {
        if !self.inner.needs_centres() {
            return self.sample_frames(source.num_frames(scene)?, &[], step, num_context, rng);
        }
        let centres: Vec<_> = source.cameras(scene)?.iter().map(|camera| camera.c2w.translation.to_array()).collect();
        self.sample_frames(centres.len(), &centres, step, num_context, rng)
    }

    /// Draws the views of one item from a scene of `num_frames` frames with their camera centres, which may be left out
    /// where `inner` does not need them.
    ///
    /// The contexts are distinct and sorted: both ends of the stretch, and inner frames as `inner` says. The
    /// targets lie between the ends, inclusive, in the order drawn. Expects a sampler that [`validate`]s.
    ///
    /// # Errors
    /// [`DataError::NotEnoughFrames`] when the scene is not longer than the smallest gap at `step`;
    /// [`DataError::BadConfig`] when `num_context` is outside `[min_context, max_context]`.
    ///
    /// [`validate`]: Self::validate
    pub fn sample_frames(
        &self,
        num_frames: usize,
        centres: &[[f64; 3]],
        step: u64,
        num_context: usize,
        rng: &mut impl Rng,
    ) -> Result<ViewIndices, DataError> {
        if self.inner.needs_centres() && centres.len() != num_frames {
            let problem = format!("are {}; farthest points need one for each of {num_frames} frames", centres.len());
            return Err(DataError::bad_config("centres", problem));
        }
        let Self { min_context, max_context, .. } = self;
        if !(min_context..=max_context).contains(&&num_context) {
            let problem = format!("is {num_context}; the sampler is set to {min_context} to {max_context}");
            return Err(DataError::bad_config("num_context", problem));
        }
        let [min_gap, max_gap] = self.gap_bounds(step, num_context);
        if num_frames <= min_gap {
            return Err(DataError::NotEnoughFrames { needed: min_gap + 1, got: num_frames });
        }
        let gap = between(rng, min_gap, max_gap.min(num_frames - 1));
        let left = uniform_below(rng, num_frames - gap);
        let right = left + gap;

        let target = if self.with_replacement {
            (0..self.num_targets).map(|_| between(rng, left, right)).collect()
        } else {
            sample_from(rng, (left..=right).collect(), self.num_targets)
        };

        let inner = self.inner.choose(rng, left, right, num_context - 2, centres);
        let context = std::iter::once(left).chain(inner).chain([right]).collect();
        Ok(ViewIndices { context, target })
    }

    fn gap_divisor(&self, num_context: usize) -> usize {
        (self.max_context / num_context.max(1)).max(1)
    }
}

/// Draws stage-2 targets for a stored context set: frames between its first and last that are not contexts.
///
/// Without replacement; with replacement where there are fewer candidates than targets; from the contexts
/// themselves, with replacement, where there is no candidate at all.
///
/// # Errors
/// [`DataError::NotEnoughFrames`] when a context is not a frame of the scene; [`DataError::BadConfig`] when there are
/// no contexts.
pub fn sample_targets(
    context: &[usize],
    num_frames: usize,
    num_targets: usize,
    rng: &mut impl Rng,
) -> Result<Vec<usize>, DataError> {
    let (Some(&first), Some(&last)) = (context.iter().min(), context.iter().max()) else {
        return Err(DataError::bad_config("context", "is empty; targets lie between its first and last frame"));
    };
    if last >= num_frames {
        return Err(DataError::NotEnoughFrames { needed: last + 1, got: num_frames });
    }
    let mut candidates: Vec<usize> = (first..=last).filter(|frame| !context.contains(frame)).collect();
    if candidates.len() >= num_targets {
        return Ok(sample_from(rng, candidates, num_targets));
    }
    if candidates.is_empty() {
        candidates = context.to_vec();
    }
    Ok((0..num_targets).map(|_| candidates[uniform_below(rng, candidates.len())]).collect())
}

#[cfg(test)]
mod tests;
