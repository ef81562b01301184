//! Context views spread over a camera path.

use clift_core::{DVec3, Pose};

const MAX_STEPS: f64 = 20.0;
const MAX_FAR: usize = 1000;

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

/// Returns the cameras with wrong poses of a reconstruction, which would set the scale of the scene, in order: a minority
/// that a gap separates from the others, of [`MAX_STEPS`] median distances from the median centre, and those that are
/// farther from all others than [`MAX_STEPS`] median steps between successive cameras.
pub(crate) fn far_cameras(centres: &[DVec3]) -> Vec<usize> {
    let median = |mut values: Vec<f64>| {
        values.sort_unstable_by(f64::total_cmp);
        values.get(values.len() / 2).copied().unwrap_or_default()
    };
    let middle = DVec3::from([0, 1, 2].map(|axis| median(centres.iter().map(|centre| centre[axis]).collect())));
    let distances: Vec<f64> = centres.iter().map(|centre| centre.distance(middle)).collect();
    let largest_gap = MAX_STEPS * median(distances.clone());
    let mut sorted = distances.clone();
    sorted.sort_unstable_by(f64::total_cmp);
    let gap = sorted.windows(2).find(|pair| largest_gap > 0.0 && pair[1] - pair[0] > largest_gap);
    let last = gap.map_or(f64::INFINITY, |pair| pair[0]);
    let (near, mut far): (Vec<usize>, Vec<usize>) = (0..centres.len()).partition(|frame| distances[*frame] <= last);
    let centres: Vec<DVec3> = near.iter().map(|frame| centres[*frame]).collect();
    far.extend(lonely_cameras(&centres).into_iter().map(|position| near[position]));
    far.sort_unstable();
    far
}

fn lonely_cameras(centres: &[DVec3]) -> Vec<usize> {
    let mut steps: Vec<f64> = centres.windows(2).map(|pair| pair[0].distance(pair[1])).collect();
    let reach = |frame: usize| {
        let step = |at: Option<usize>| at.and_then(|at| steps.get(at)).copied().unwrap_or(f64::INFINITY);
        step(frame.checked_sub(1)).min(step(Some(frame)))
    };
    let reaches: Vec<f64> = (0..centres.len()).map(reach).collect();
    steps.sort_unstable_by(f64::total_cmp);
    let Some(&median) = steps.get(steps.len().saturating_sub(1) / 2).filter(|median| **median > 0.0) else {
        return Vec::new();
    };
    let is_far = |distance: f64| distance > MAX_STEPS * median;
    let is_alone = |frame: usize| {
        let mut others = centres.iter().enumerate().filter(|(other, _)| *other != frame);
        others.all(|(_, centre)| is_far(centre.distance(centres[frame])))
    };
    let mut far: Vec<usize> = (0..centres.len()).filter(|frame| is_far(reaches[*frame])).take(MAX_FAR).collect();
    far.retain(|frame| is_alone(*frame));
    far
}

#[cfg(test)]
mod tests {
    use super::*;

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
        // Without a path, frames are spread by number.
        assert_eq!(contexts_along_path(&at(&[2.0; 7]), 3), Some(vec![0, 3, 6]));
        assert_eq!(contexts_along_path(&at(&[0.0, 1.0]), 3), None);
        assert_eq!(contexts_along_path(&at(&[0.0]), 0), None);
        assert_eq!(contexts_along_path(&[], 1), None);
        assert_eq!(contexts_along_path(&at(&[0.0, f64::NAN, 1.0]), 2), Some(vec![0, 2]));
    }

    #[test]
    fn far_cameras_are_a_separate_minority() {
        let steady: Vec<f64> = (0..8).map(f64::from).collect();
        let with = |changes: &[(usize, f64)]| {
            let mut places = steady.clone();
            for (frame, place) in changes {
                places[*frame] = *place;
            }
            places
        };
        let rests = [[0.0; 5].as_slice(), &[0.01, 1.0, 2.0, 3.0]].concat();
        let approach: Vec<f64> =
            (0..40).map(|i| if i < 30 { 0.1 * f64::from(i % 10) } else { f64::from(i) - 29.0 }).collect();
        for (places, far) in [
            (steady.clone(), vec![]),
            (with(&[(3, 400.0)]), vec![3]),
            (with(&[(3, 400.0), (5, 600.0)]), vec![3, 5]),
            (with(&[(3, 1e5), (5, 1e5), (0, -1e5)]), vec![0, 3, 5]),
            (with(&[(2, 1e5), (3, 2e5)]), vec![2, 3]),
            (with(&[(0, 1e5), (1, 1e5), (2, 1e5), (3, 1e5)]), vec![]),
            (rests, vec![]),
            (approach, vec![]),
            (vec![0.0, 1e5], vec![]),
            (vec![], vec![]),
        ] {
            let centres: Vec<DVec3> = places.iter().map(|place| *place * DVec3::X).collect();
            assert_eq!(far_cameras(&centres), far, "{places:?}");
        }
    }
}
