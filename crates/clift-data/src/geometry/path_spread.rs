//! Context views spread over a camera path.

use crate::geometry::pose::Pose;

/// `num_views` frames from the first to the last, evenly along the path of the camera centres: while the camera rests
/// or turns on the spot, one view replaces many. Evenly over the frames if all centres coincide or one is not finite.
/// `None` for fewer frames than views, or for no views.
pub fn contexts_along_path(c2w: &[Pose], num_views: usize) -> Option<Vec<usize>> {
    let num_frames = c2w.len();
    if num_views == 0 || num_frames < num_views {
        return None;
    }
    // Distance travelled up to every frame.
    let mut gone = vec![0.0];
    for pair in c2w.windows(2) {
        gone.push(gone[gone.len() - 1] + pair[0].translation.distance(pair[1].translation));
    }
    let length = gone[num_frames - 1];
    if !(length > 0.0 && length.is_finite()) {
        gone = (0..num_frames).map(|frame| frame as f64).collect();
    }
    let length = gone[num_frames - 1];
    let mut frames: Vec<usize> = Vec::with_capacity(num_views);
    for place in 0..num_views {
        let share = if num_views == 1 { 0.5 } else { place as f64 / (num_views - 1) as f64 };
        let first = frames.last().map_or(0, |frame| frame + 1);
        let last = num_frames - (num_views - place);
        let distance = |frame: usize| (gone[frame] - share * length).abs();
        let nearest = (first..=last).min_by(|&a, &b| distance(a).total_cmp(&distance(b)))?;
        frames.push(nearest);
    }
    Some(frames)
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use proptest::prelude::*;

    use super::*;

    fn at(places: &[f64]) -> Vec<Pose> {
        places.iter().map(|&x| Pose { translation: x * DVec3::X, ..Pose::IDENTITY }).collect()
    }

    #[test]
    fn views_are_spread_over_the_way_and_not_over_the_time() {
        let steady: Vec<f64> = (0..10).map(f64::from).collect();
        assert_eq!(contexts_along_path(&at(&steady), 4), Some(vec![0, 3, 6, 9]));
        assert_eq!(contexts_along_path(&at(&steady), 1), Some(vec![4]));
        // The camera rests for six frames, then goes fast.
        let rests = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 2.0, 3.0, 3.0];
        assert_eq!(contexts_along_path(&at(&rests), 4), Some(vec![0, 6, 7, 8]));
        // There and back counts as a way.
        assert_eq!(contexts_along_path(&at(&[0.0, 1.0, 2.0, 1.0, 0.0]), 3), Some(vec![0, 2, 4]));
    }

    #[test]
    fn a_camera_that_stands_still_gives_frames_evenly_and_too_few_frames_none() {
        assert_eq!(contexts_along_path(&at(&[2.0; 7]), 3), Some(vec![0, 3, 6]));
        assert_eq!(contexts_along_path(&at(&[0.0, 1.0]), 3), None);
        assert_eq!(contexts_along_path(&at(&[0.0]), 0), None);
        assert_eq!(contexts_along_path(&[], 1), None);
        assert_eq!(contexts_along_path(&at(&[0.0, f64::NAN, 1.0]), 2), Some(vec![0, 2]));
    }

    proptest! {
        #[test]
        fn views_are_as_many_as_asked_for_and_in_order(
            places in prop::collection::vec(-3.0_f64..3.0, 1..40), num_views in 1_usize..40,
        ) {
            let frames = contexts_along_path(&at(&places), num_views);
            prop_assert_eq!(frames.is_some(), num_views <= places.len());
            let frames = frames.unwrap_or_default();
            prop_assert!(frames.windows(2).all(|pair| pair[0] < pair[1]));
            prop_assert!(frames.iter().all(|&frame| frame < places.len()));
        }
    }
}
