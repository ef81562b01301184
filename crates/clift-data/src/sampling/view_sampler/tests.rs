//! What the sampler promises.

use std::collections::BTreeSet;

use proptest::prelude::*;

use super::*;
use crate::random::item_rng;

fn sampler() -> ViewSampler {
    ViewSampler::default()
}

/// Smallest and largest of many drawn gaps.
fn gaps(sampler: &ViewSampler, num_frames: usize, step: u64, num_context: usize) -> [usize; 2] {
    let gaps: BTreeSet<usize> = (0..4_000)
        .map(|slot| {
            let mut rng = item_rng(1, step, slot, 0, "test");
            let views = sampler.sample_frames(num_frames, &[], step, num_context, &mut rng).unwrap();
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
    assert_eq!(linear_warm_up(25, 45, 30_000, 1_499), 25);
    assert_eq!(linear_warm_up(25, 45, 30_000, 1_500), 26);
    assert_eq!(linear_warm_up(25, 45, 30_000, 29_999), 44);
    assert_eq!(linear_warm_up(25, 45, 30_000, u64::MAX), 45);
    assert_eq!(linear_warm_up(25, 45, 0, 0), 45);
}

#[test]
fn a_short_scene_lowers_the_largest_gap() {
    assert_eq!(gaps(&sampler(), 31, 0, 4), [25, 30]);
}

#[test]
fn a_scene_of_smallest_gap_plus_one_frame_is_just_enough() {
    let mut rng = item_rng(1, 0, 0, 0, "test");
    let views = sampler().sample_frames(26, &[], 0, 4, &mut rng).unwrap();
    assert_eq!((views.context[0], views.context[3]), (0, 25));
    let error = sampler().sample_frames(25, &[], 0, 4, &mut rng).unwrap_err();
    assert_eq!(error.to_string(), "not enough frames: 26 needed, 25 in the scene");
    assert!(sampler().sample_frames(0, &[], 0, 4, &mut rng).is_err());
}

#[test]
fn a_number_of_contexts_outside_the_bounds_is_refused() {
    for num_context in [0, 1, 3, 7] {
        let error = sampler().sample_frames(200, &[], 0, num_context, &mut item_rng(1, 0, 0, 0, "test")).unwrap_err();
        assert_eq!(error.to_string(), format!("num_context is {num_context}; the sampler is set to 4 to 6"));
    }
}

#[test]
fn half_as_many_contexts_take_half_the_gap() {
    let sampler = ViewSampler { min_context: 2, ..sampler() };
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
    let views = sampler().sample_frames(279, &[], 1_500, 6, &mut item_rng(7, 1_500, 3, 0, "views")).unwrap();
    assert_eq!(views.context, [168, 189, 195, 202, 204, 208]);
    assert_eq!(views.target, [170, 196, 205, 194, 172, 203]);
}

#[test]
fn every_inner_frame_is_equally_likely_to_be_a_context() {
    // Gap 25 with 4 contexts: each of 24 inner frames is drawn with chance 1/12, 1,000 of 12,000 times;
    // the deviation is 30.
    let sampler = ViewSampler { max_gap: [25, 45], ..sampler() };
    let mut counts = [0_i32; 26];
    for slot in 0..12_000 {
        let views = sampler.sample_frames(26, &[], 0, 4, &mut item_rng(1, 0, slot, 0, "test")).unwrap();
        views.context.iter().for_each(|&frame| counts[frame] += 1);
    }
    assert_eq!((counts[0], counts[25]), (12_000, 12_000));
    assert!(counts[1..25].iter().all(|count| (count - 1_000).abs() < 150), "{counts:?}");
}

#[test]
fn a_config_names_the_key_the_value_and_the_fix() {
    let check = |sampler: ViewSampler| sampler.validate().unwrap_err().to_string();
    assert!(sampler().validate().is_ok());
    assert_eq!(
        check(ViewSampler { min_context: 1, ..sampler() }),
        "min_context is 1; a stretch has two ends, so use 2 or more"
    );
    assert!(check(ViewSampler { max_context: 3, ..sampler() }).starts_with("max_context is 3"));
    assert!(check(ViewSampler { num_targets: 0, ..sampler() }).starts_with("num_targets is 0"));
    for huge in [10_001, usize::MAX] {
        let expected = format!("max_context is {huge}; use 10000 or fewer");
        assert_eq!(check(ViewSampler { max_context: huge, ..sampler() }), expected);
        let expected = format!("num_targets is {huge}; use 10000 or fewer");
        assert_eq!(check(ViewSampler { num_targets: huge, ..sampler() }), expected);
    }
    assert!(check(ViewSampler { min_gap: [30, 25], ..sampler() }).starts_with("min_gap is [30, 25]"));
    assert!(check(ViewSampler { max_gap: [45, 40], ..sampler() }).starts_with("max_gap is [45, 40]"));
    assert!(check(ViewSampler { max_gap: [20, 135], ..sampler() }).starts_with("max_gap is [20, 135]"));
    assert!(check(ViewSampler { min_gap: [4, 45], ..sampler() }).contains("6 distinct contexts need a gap of 5"));
    assert!(
        check(ViewSampler { num_targets: 27, with_replacement: false, ..sampler() }).starts_with("num_targets is 27")
    );
}

#[test]
fn an_unknown_key_is_refused() {
    let parsed: Result<ViewSampler, _> = serde_json::from_str(r#"{"min_gaps": [1, 2]}"#);
    assert!(parsed.unwrap_err().to_string().contains("min_gaps"));
}

#[test]
fn stage_two_targets_are_distinct_inner_frames_while_there_are_enough() {
    let mut rng = item_rng(1, 0, 0, 0, "test");
    let mut targets = sample_targets(&[9, 3, 5], 20, 4, &mut rng).unwrap();
    targets.sort_unstable();
    assert_eq!(targets, [4, 6, 7, 8]);
}

#[test]
fn stage_two_targets_repeat_when_candidates_are_few_and_fall_back_to_the_contexts() {
    let mut rng = item_rng(1, 0, 0, 0, "test");
    assert_eq!(sample_targets(&[3, 5], 20, 3, &mut rng).unwrap(), [4, 4, 4]);
    let targets = sample_targets(&[3, 4, 5], 20, 6, &mut rng).unwrap();
    assert_eq!(targets.len(), 6);
    assert!(targets.iter().all(|target| (3..=5).contains(target)));
}

#[test]
fn stage_two_contexts_beyond_the_scene_are_refused() {
    let mut rng = item_rng(1, 0, 0, 0, "test");
    let message = sample_targets(&[3, 20], 20, 3, &mut rng).unwrap_err().to_string();
    assert_eq!(message, "not enough frames: 21 needed, 20 in the scene");
    assert!(sample_targets(&[], 20, 3, &mut rng).is_err());
}

#[test]
fn scenes_give_their_centres_where_farthest_points_are_asked_for() {
    let config = crate::synthetic::config::SyntheticConfig { num_scenes: 1, num_frames: 40, ..Default::default() };
    let source = crate::synthetic::source::SyntheticSource::new(config).unwrap();
    let centres: Vec<_> = source.cameras(0).unwrap().iter().map(|camera| camera.c2w.translation.to_array()).collect();
    for inner in [InnerViews::Random, InnerViews::FarthestPoint, InnerViews::Even] {
        let sampler = ViewSampler { inner, ..sampler() };
        let drawn = sampler.sample(&source, 0, 0, 5, &mut item_rng(1, 0, 0, 0, "test")).unwrap();
        let sampled = sampler.sample_frames(40, &centres, 0, 5, &mut item_rng(1, 0, 0, 0, "test")).unwrap();
        assert_eq!(drawn, sampled);
    }
    let sampler = ViewSampler { inner: InnerViews::FarthestPoint, ..sampler() };
    let message = sampler.sample_frames(40, &[], 0, 5, &mut item_rng(1, 0, 0, 0, "test")).unwrap_err().to_string();
    assert_eq!(message, "centres are 0; farthest points need one for each of 40 frames");
}

#[test]
fn the_choice_of_inner_views_changes_neither_ends_nor_targets_and_is_not_written_by_default() {
    let centres: Vec<_> = (0..200).map(|frame| [f64::from(frame), 0.0, 0.0]).collect();
    let views = [InnerViews::Random, InnerViews::FarthestPoint, InnerViews::Even].map(|inner| {
        let sampler = ViewSampler { inner, ..sampler() };
        sampler.sample_frames(200, &centres, 15_000, 6, &mut item_rng(3, 0, 0, 0, "test")).unwrap()
    });
    for other in &views[1..] {
        assert_eq!((other.context[0], other.context[5]), (views[0].context[0], views[0].context[5]));
        assert_eq!(other.target, views[0].target);
        assert_ne!(other.context, views[0].context);
    }
    assert!(!serde_json::to_string(&sampler()).unwrap().contains("inner"));
    let even = ViewSampler { inner: InnerViews::Even, ..sampler() };
    assert!(serde_json::to_string(&even).unwrap().contains(r#""inner":"even""#));
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
        let sampler = ViewSampler { with_replacement, ..sampler() };
        let [min_gap, max_gap] = sampler.gap_bounds(step, num_context);
        let draw = || sampler.sample_frames(num_frames, &[], step, num_context, &mut item_rng(seed, step, 0, 0, "test"));
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

    #[test]
    fn two_to_eight_contexts_hold_their_bounds_at_every_step_and_in_small_scenes(
        seed: u64,
        num_frames in 0_usize..200,
        step in prop::sample::select(vec![0_u64, 1_500, 15_000, 30_000]),
        num_context in 2_usize..=8,
        with_replacement: bool,
        inner in prop::sample::select(vec![InnerViews::Random, InnerViews::FarthestPoint, InnerViews::Even]),
    ) {
        let sampler = ViewSampler { min_context: 2, max_context: 8, with_replacement, inner, ..sampler() };
        sampler.validate().unwrap();
        // Gaps of the protocol at these steps, for 5 to 8 contexts; fewer take a half or a quarter.
        let [low, high] = match step { 0 => [25, 45], 1_500 => [26, 49], 15_000 => [35, 90], _ => [45, 135] };
        let divisor = 8 / num_context;
        let (min_gap, max_gap) = (low / divisor, high / divisor);
        // A camera that goes in circles and rests now and then.
        let centre = |frame: usize| [(frame / 3) as f64, ((frame / 3) as f64).sin(), 0.0];
        let centres: Vec<_> = (0..num_frames).map(centre).collect();
        let mut rng = item_rng(seed, step, 0, 0, "test");
        let Ok(ViewIndices { context, target }) = sampler.sample_frames(num_frames, &centres, step, num_context, &mut rng) else {
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
        if !with_replacement {
            prop_assert_eq!(target.iter().collect::<BTreeSet<_>>().len(), 6);
        }
    }
}
