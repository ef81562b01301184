//! Which frames of a scene become context and target views of a training item.

use rand::Rng;
use serde::{Deserialize, Serialize};

use crate::clip::ViewIndices;
use crate::error::DataError;
use crate::order::{below, between, distinct, draw_from, step_rng};

/// Most context or target views of an item.
const MAX_VIEWS: usize = 10_000;

/// Value at `step` of a number that grows linearly from `init` to `last` in `warm_up_steps` steps and then stays:
/// `min(init + trunc((last - init) * step / warm_up_steps), last)`.
///
/// Expects `init <= last`; without warm-up steps the value is `last` from the start.
pub fn schedule(init: usize, last: usize, warm_up_steps: u64, step: u64) -> usize {
    if warm_up_steps == 0 || step >= warm_up_steps {
        return last;
    }
    let growth = last.saturating_sub(init) as u128 * u128::from(step) / u128::from(warm_up_steps);
    init + growth as usize
}

/// Draws a stretch of a scene, whose two ends and random inner frames are the context, and targets from inside it.
///
/// The stretch grows during training: its gap (last minus first frame) is uniform in `[min_gap, max_gap]`, both on
/// the [`schedule`] of `warm_up_steps`. This is the `bounded_v2` sampler of DepthSplat, which the paper trains with;
/// the default is its RealEstate10K setting with the paper's 4 to 6 contexts (paper, appendix).
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct BoundedSampler {
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
}

impl Default for BoundedSampler {
    fn default() -> Self {
        Self {
            min_context: 4,
            max_context: 6,
            min_gap: [25, 45],
            max_gap: [45, 135],
            warm_up_steps: 30_000,
            num_targets: 6,
            with_replacement: true,
        }
    }
}

impl BoundedSampler {
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
            .map(|[init, last]| schedule(init, last, self.warm_up_steps, step) / self.gap_divisor(num_context))
    }

    /// Draws the views of one item from a scene of `num_frames` frames.
    ///
    /// The contexts are distinct and sorted: both ends of the stretch, and inner frames drawn uniformly. The
    /// targets lie between the ends, inclusive, in the order drawn. Expects a sampler that [`validate`]s.
    ///
    /// # Errors
    /// [`DataError::NotEnoughFrames`] when the scene is not longer than the smallest gap at `step`;
    /// [`DataError::BadConfig`] when `num_context` is outside `[min_context, max_context]`.
    ///
    /// [`validate`]: Self::validate
    pub fn sample(
        &self,
        num_frames: usize,
        step: u64,
        num_context: usize,
        rng: &mut impl Rng,
    ) -> Result<ViewIndices, DataError> {
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
        let left = below(rng, num_frames - gap);
        let right = left + gap;

        let target = if self.with_replacement {
            (0..self.num_targets).map(|_| between(rng, left, right)).collect()
        } else {
            draw_from(rng, (left..=right).collect(), self.num_targets)
        };

        let inner = distinct(rng, gap - 1, num_context - 2).into_iter().map(|offset| left + 1 + offset);
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
pub fn targets_excluding(
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
        return Ok(draw_from(rng, candidates, num_targets));
    }
    if candidates.is_empty() {
        candidates = context.to_vec();
    }
    Ok((0..num_targets).map(|_| candidates[below(rng, candidates.len())]).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::order::item_rng;
    use proptest::prelude::*;
    use std::collections::BTreeSet;

    fn sampler() -> BoundedSampler {
        BoundedSampler::default()
    }

    /// Smallest and largest of many drawn gaps.
    fn gaps(sampler: &BoundedSampler, num_frames: usize, step: u64, num_context: usize) -> [usize; 2] {
        let gaps: BTreeSet<usize> = (0..4_000)
            .map(|slot| {
                let mut rng = item_rng(1, step, slot, 0, "test");
                let views = sampler.sample(num_frames, step, num_context, &mut rng).unwrap();
                views.context[num_context - 1] - views.context[0]
            })
            .collect();
        [*gaps.first().unwrap(), *gaps.last().unwrap()]
    }

    #[test]
    fn gaps_grow_with_the_step_and_fill_their_bounds() {
        for (step, bounds) in
            [(0, [25, 45]), (1_500, [26, 49]), (15_000, [35, 90]), (30_000, [45, 135]), (900_000, [45, 135])]
        {
            assert_eq!(sampler().gap_bounds(step, 4), bounds, "step {step}");
            assert_eq!(gaps(&sampler(), 1_000, step, 4), bounds, "step {step}");
        }
    }

    #[test]
    fn the_schedule_truncates_and_stays_at_its_last_value() {
        assert_eq!(schedule(25, 45, 30_000, 1_499), 25);
        assert_eq!(schedule(25, 45, 30_000, 1_500), 26);
        assert_eq!(schedule(25, 45, 30_000, 29_999), 44);
        assert_eq!(schedule(25, 45, 30_000, u64::MAX), 45);
        assert_eq!(schedule(25, 45, 0, 0), 45);
    }

    #[test]
    fn a_short_scene_lowers_the_largest_gap() {
        assert_eq!(gaps(&sampler(), 31, 0, 4), [25, 30]);
    }

    #[test]
    fn a_scene_of_smallest_gap_plus_one_frame_is_just_enough() {
        let mut rng = item_rng(1, 0, 0, 0, "test");
        let views = sampler().sample(26, 0, 4, &mut rng).unwrap();
        assert_eq!((views.context[0], views.context[3]), (0, 25));
        let error = sampler().sample(25, 0, 4, &mut rng).unwrap_err();
        assert_eq!(error.to_string(), "not enough frames: 26 needed, 25 in the scene");
        assert!(sampler().sample(0, 0, 4, &mut rng).is_err());
    }

    #[test]
    fn a_number_of_contexts_outside_the_bounds_is_refused() {
        for num_context in [0, 1, 3, 7] {
            let error = sampler().sample(200, 0, num_context, &mut item_rng(1, 0, 0, 0, "test")).unwrap_err();
            assert_eq!(error.to_string(), format!("num_context is {num_context}; the sampler is set to 4 to 6"));
        }
    }

    #[test]
    fn half_as_many_contexts_take_half_the_gap() {
        let sampler = BoundedSampler { min_context: 2, ..sampler() };
        assert_eq!(sampler.gap_bounds(0, 6), [25, 45]);
        assert_eq!(sampler.gap_bounds(0, 4), [25, 45]);
        assert_eq!(sampler.gap_bounds(0, 3), [12, 22]);
        assert_eq!(sampler.gap_bounds(0, 2), [8, 15]);
    }

    #[test]
    fn the_number_of_contexts_is_a_function_of_seed_and_step_and_takes_every_value() {
        let drawn: Vec<usize> = (0..200).map(|step| sampler().num_context(5, step)).collect();
        assert_eq!(drawn, (0..200).map(|step| sampler().num_context(5, step)).collect::<Vec<_>>());
        assert_ne!(drawn, (0..200).map(|step| sampler().num_context(6, step)).collect::<Vec<_>>());
        assert_eq!(drawn.into_iter().collect::<BTreeSet<_>>(), [4, 5, 6].into());
    }

    // The expected values come from an implementation of this sampler in Python.
    #[test]
    fn samples_are_the_same_on_every_platform_and_in_every_release() {
        let views = sampler().sample(279, 1_500, 6, &mut item_rng(7, 1_500, 3, 0, "views")).unwrap();
        assert_eq!(views.context, [168, 189, 195, 202, 204, 208]);
        assert_eq!(views.target, [170, 196, 205, 194, 172, 203]);
    }

    #[test]
    fn every_inner_frame_is_equally_likely_to_be_a_context() {
        // Gap 25 with 4 contexts: each of 24 inner frames is drawn with chance 1/12, 1,000 of 12,000 times;
        // the deviation is 30.
        let sampler = BoundedSampler { max_gap: [25, 45], ..sampler() };
        let mut counts = [0_i32; 26];
        for slot in 0..12_000 {
            let views = sampler.sample(26, 0, 4, &mut item_rng(1, 0, slot, 0, "test")).unwrap();
            views.context.iter().for_each(|&frame| counts[frame] += 1);
        }
        assert_eq!((counts[0], counts[25]), (12_000, 12_000));
        assert!(counts[1..25].iter().all(|count| (count - 1_000).abs() < 150), "{counts:?}");
    }

    #[test]
    fn a_config_names_the_key_the_value_and_the_fix() {
        let check = |sampler: BoundedSampler| sampler.validate().unwrap_err().to_string();
        assert!(sampler().validate().is_ok());
        assert_eq!(
            check(BoundedSampler { min_context: 1, ..sampler() }),
            "min_context is 1; a stretch has two ends, so use 2 or more"
        );
        assert!(check(BoundedSampler { max_context: 3, ..sampler() }).starts_with("max_context is 3"));
        assert!(check(BoundedSampler { num_targets: 0, ..sampler() }).starts_with("num_targets is 0"));
        for huge in [10_001, usize::MAX] {
            let expected = format!("max_context is {huge}; use 10000 or fewer");
            assert_eq!(check(BoundedSampler { max_context: huge, ..sampler() }), expected);
            let expected = format!("num_targets is {huge}; use 10000 or fewer");
            assert_eq!(check(BoundedSampler { num_targets: huge, ..sampler() }), expected);
        }
        assert!(check(BoundedSampler { min_gap: [30, 25], ..sampler() }).starts_with("min_gap is [30, 25]"));
        assert!(check(BoundedSampler { max_gap: [45, 40], ..sampler() }).starts_with("max_gap is [45, 40]"));
        assert!(check(BoundedSampler { max_gap: [20, 135], ..sampler() }).starts_with("max_gap is [20, 135]"));
        assert!(
            check(BoundedSampler { min_gap: [4, 45], ..sampler() }).contains("6 distinct contexts need a gap of 5")
        );
        assert!(
            check(BoundedSampler { num_targets: 27, with_replacement: false, ..sampler() })
                .starts_with("num_targets is 27")
        );
    }

    #[test]
    fn an_unknown_key_is_refused() {
        let parsed: Result<BoundedSampler, _> = serde_json::from_str(r#"{"min_gaps": [1, 2]}"#);
        assert!(parsed.unwrap_err().to_string().contains("min_gaps"));
    }

    #[test]
    fn stage_two_targets_are_distinct_inner_frames_while_there_are_enough() {
        let mut rng = item_rng(1, 0, 0, 0, "test");
        let mut targets = targets_excluding(&[9, 3, 5], 20, 4, &mut rng).unwrap();
        targets.sort_unstable();
        assert_eq!(targets, [4, 6, 7, 8]);
    }

    #[test]
    fn stage_two_targets_repeat_when_candidates_are_few_and_fall_back_to_the_contexts() {
        let mut rng = item_rng(1, 0, 0, 0, "test");
        assert_eq!(targets_excluding(&[3, 5], 20, 3, &mut rng).unwrap(), [4, 4, 4]);
        let targets = targets_excluding(&[3, 4, 5], 20, 6, &mut rng).unwrap();
        assert_eq!(targets.len(), 6);
        assert!(targets.iter().all(|target| (3..=5).contains(target)));
    }

    #[test]
    fn stage_two_contexts_beyond_the_scene_are_refused() {
        let mut rng = item_rng(1, 0, 0, 0, "test");
        let message = targets_excluding(&[3, 20], 20, 3, &mut rng).unwrap_err().to_string();
        assert_eq!(message, "not enough frames: 21 needed, 20 in the scene");
        assert!(targets_excluding(&[], 20, 3, &mut rng).is_err());
    }

    proptest! {
        #[test]
        fn contexts_are_distinct_sorted_frames_and_targets_lie_between_them(
            seed: u64,
            num_frames in 0_usize..300,
            step in 0_u64..60_000,
            num_context in 4_usize..=6,
            with_replacement: bool,
        ) {
            let sampler = BoundedSampler { with_replacement, ..sampler() };
            let [min_gap, max_gap] = sampler.gap_bounds(step, num_context);
            let draw = || sampler.sample(num_frames, step, num_context, &mut item_rng(seed, step, 0, 0, "test"));
            let Ok(views) = draw() else {
                prop_assert!(num_frames <= min_gap);
                return Ok(());
            };
            prop_assert_eq!(&views, &draw().unwrap());
            prop_assert_eq!(views.context.len(), num_context);
            prop_assert!(views.context.windows(2).all(|pair| pair[0] < pair[1]));
            let (first, last) = (views.context[0], views.context[num_context - 1]);
            prop_assert!(last < num_frames && (min_gap..=max_gap).contains(&(last - first)));
            prop_assert_eq!(views.target.len(), 6);
            prop_assert!(views.target.iter().all(|target| (first..=last).contains(target)));
            if !with_replacement {
                prop_assert_eq!(views.target.iter().collect::<BTreeSet<_>>().len(), 6);
            }
        }
    }
}
