//! Context views spread over a camera path.

use clift_core::Pose;

/// Selects `num_views` frames from the first to the last at even distances along the path of the camera centres.
///
/// Frames are spaced evenly by number instead if all centres coincide or one is not finite. Returns `None` for fewer
/// frames than views, and for no views.
pub fn contexts_along_path(c2w: &[Pose], num_views: usize) -> Option<Vec<usize>> {
    let num_frames = c2w.len();
    if num_views == 0 || num_frames < num_views {
        return None;
    }
    // Length of the path up to every frame.
    let mut travelled = vec![0.0];
    for pair in c2w.windows(2) {
        travelled.push(travelled[travelled.len() - 1] + pair[0].translation.distance(pair[1].translation));
    }
    let length = travelled[num_frames - 1];
    if !(length > 0.0 && length.is_finite()) {
        travelled = (0..num_frames).map(|frame| frame as f64).collect();
    }
    let length = travelled[num_frames - 1];
    let mut frames: Vec<usize> = Vec::with_capacity(num_views);
    for view in 0..num_views {
        let share = if num_views == 1 { 0.5 } else { view as f64 / (num_views - 1) as f64 };
        let first = frames.last().map_or(0, |frame| frame + 1);
        let last = num_frames - (num_views - view);
        let distance = |frame: usize| (travelled[frame] - share * length).abs();
        frames.push((first..=last).min_by(|&a, &b| distance(a).total_cmp(&distance(b)))?);
    }
    Some(frames)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;
    use proptest::prelude::*;

    fn at(places: &[f64]) -> Vec<Pose> {
        places.iter().map(|&x| Pose { translation: x * DVec3::X, ..Pose::IDENTITY }).collect()
    }

    #[test]
    fn views_are_spread_by_distance_not_by_time() {
        let steady: Vec<f64> = (0..10).map(f64::from).collect();
        assert_eq!(contexts_along_path(&at(&steady), 4), Some(vec![0, 3, 6, 9]));
        assert_eq!(contexts_along_path(&at(&steady), 1), Some(vec![4]));
        // The camera rests for six frames, then moves.
        let rests = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 2.0, 3.0, 3.0];
        assert_eq!(contexts_along_path(&at(&rests), 4), Some(vec![0, 6, 7, 8]));
        // The path leads back to its start.
        assert_eq!(contexts_along_path(&at(&[0.0, 1.0, 2.0, 1.0, 0.0]), 3), Some(vec![0, 2, 4]));
    }

    #[test]
    fn resting_camera_spaces_frames_evenly() {
        assert_eq!(contexts_along_path(&at(&[2.0; 7]), 3), Some(vec![0, 3, 6]));
        assert_eq!(contexts_along_path(&at(&[0.0, 1.0]), 3), None);
        assert_eq!(contexts_along_path(&at(&[0.0]), 0), None);
        assert_eq!(contexts_along_path(&[], 1), None);
        assert_eq!(contexts_along_path(&at(&[0.0, f64::NAN, 1.0]), 2), Some(vec![0, 2]));
    }

    proptest! {
        #[test]
        fn views_are_sorted_and_as_many_as_requested(
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
