//! Sampled views stay within the bounds of the sampler, and equal those of an implementation in Python.

use super::*;
use clift_core::{DVec3, item_rng};
use proptest::prelude::*;
use std::collections::BTreeSet;

fn sampler() -> ViewSampler {
    ViewSampler::default()
}

// The expected values come from an implementation of this sampler in Python.
#[test]
fn samples_are_reproducible() {
    let views = sampler().sample_frames(279, None, 1_500, 6, &mut item_rng(7, 1_500, 3, 0, "views")).unwrap();
    assert_eq!(views.context, [168, 189, 195, 202, 204, 208]);
    assert_eq!(views.target, [170, 196, 205, 194, 172, 203]);
}

#[test]
fn invalid_value_is_named_with_its_key() {
    assert!(sampler().validate().is_ok());
    for (invalid, expected) in [
        (ViewSampler { max_context: 10_001, ..sampler() }, "`max_context` = 10001: use 10000 or fewer"),
        (ViewSampler { num_targets: 0, ..sampler() }, "`num_targets` = 0"),
        (ViewSampler { num_targets: usize::MAX, ..sampler() }, "`num_targets` = 18446744073709551615: use 10000 or"),
        (ViewSampler { min_gap: [30, 25], ..sampler() }, "`min_gap` = [30, 25]"),
        (ViewSampler { min_gap: [4, 45], ..sampler() }, "`min_gap` = [4, 45]: 6 distinct contexts need a gap of 5"),
        (ViewSampler { max_gap: [45, 40], ..sampler() }, "`max_gap` = [45, 40]"),
        (ViewSampler { max_gap: [20, 135], ..sampler() }, "`max_gap` = [20, 135]"),
    ] {
        let message = invalid.validate().unwrap_err().to_string();
        assert!(message.starts_with(expected), "{message}");
    }
}

#[test]
fn stage_two_targets_are_no_contexts_while_others_exist() {
    let mut rng = item_rng(1, 0, 0, 0, "test");
    let mut sorted = |context: &[usize], count: usize| {
        target_candidates(context, 20, None).map(|candidates| {
            let mut targets = sample_candidates(context, candidates, count, &mut rng);
            targets.sort_unstable();
            targets
        })
    };
    assert_eq!(sorted(&[9, 3, 5], 4).unwrap(), [4, 6, 7, 8]);
    assert_eq!(sorted(&[3, 5], 3).unwrap(), [4, 4, 4]);
    let only_contexts = sorted(&[3, 4, 5], 6).unwrap();
    assert!(only_contexts.len() == 6 && only_contexts.iter().all(|target| (3..=5).contains(target)));
    assert_eq!(sorted(&[3, 20], 3).unwrap_err().to_string(), "not enough frames: 21 needed, 20 in the scene");
    assert!(sorted(&[], 3).is_err());
}

#[test]
fn nearest_frames_are_neighbours_in_space_in_any_order() {
    // Frame 7 * i is at place i of a line.
    let place = |frame: usize| frame * 23 % 40;
    let pose = |frame| Pose { translation: place(frame) as f64 * DVec3::X, ..Pose::IDENTITY };
    let poses: Vec<Pose> = (0..40).map(pose).collect();
    let gaps = ViewSampler { min_gap: [8, 8], max_gap: [8, 8], warm_up_steps: 0, ..sampler() };
    for seed in 0..50 {
        let mut rng = item_rng(seed, 0, 0, 0, "test");
        let ViewIndices { context, target } = gaps.sample_frames(40, Some(&poses), 0, 6, &mut rng).unwrap();
        assert!(context.len() == 6 && target.len() == 6 && context.is_sorted_by(|a, b| a < b), "{context:?}");
        let places: BTreeSet<usize> = context.iter().chain(&target).map(|&frame| place(frame)).collect();
        assert!(places.last().unwrap() - places.first().unwrap() <= 8, "{places:?}");
        // Contexts are at most 4 places from the next.
        let targets = target_candidates(&context, 40, Some(&poses)).unwrap();
        assert!(targets.iter().all(|frame| !context.contains(frame)));
        assert!(targets.iter().all(|&frame| places.iter().any(|near| near.abs_diff(place(frame)) <= 4)), "{targets:?}");
    }
    assert!(gaps.sample_frames(8, Some(&poses[..8]), 0, 6, &mut item_rng(0, 0, 0, 0, "test")).is_err());
}

proptest! {
    #[test]
    fn sampled_views_stay_within_the_bounds(
        seed: u64,
        num_frames in 0_usize..200,
        step in prop::sample::select(vec![0_u64, 1_500, 15_000, 30_000]),
        num_context in 2_usize..=8,
    ) {
        let sampler = ViewSampler { min_context: 2, max_context: 8, ..sampler() };
        sampler.validate().unwrap();
        // Gaps of the protocol at these steps for 5 to 8 contexts; a half or a quarter for fewer.
        let [low, high] = match step { 0 => [25, 45], 1_500 => [26, 49], 15_000 => [35, 90], _ => [45, 135] };
        let divisor = 8 / num_context;
        let (min_gap, max_gap) = (low / divisor, high / divisor);
        let mut rng = item_rng(seed, step, 0, 0, "test");
        let sampled = sampler.sample_frames(num_frames, None, step, num_context, &mut rng);
        let Ok(ViewIndices { context, target }) = sampled else {
            prop_assert!(num_frames <= min_gap);
            return Ok(());
        };
        prop_assert!(num_frames > min_gap);
        prop_assert_eq!(context.len(), num_context);
        prop_assert!(context.is_sorted_by(|a, b| a < b), "{:?}", context);
        let (first, last) = (context[0], context[num_context - 1]);
        prop_assert!(last < num_frames);
        prop_assert!((min_gap..=max_gap.min(num_frames - 1)).contains(&(last - first)), "{first} to {last}");
        prop_assert_eq!(target.len(), 6);
        prop_assert!(target.iter().all(|frame| (first..=last).contains(frame)));
    }
}
