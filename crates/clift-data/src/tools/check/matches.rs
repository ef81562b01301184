//! Corners matched between the frames of a scene. The cameras do not decide which corners match.

use clift_core::{Camera, IntrinsicsNorm};
use rayon::prelude::*;

use crate::tools::features::epipolar::Correspondence;
use crate::tools::features::image_features::Features;

/// Largest number of frames of which every pair is matched.
const MAX_ALL_PAIRS: usize = 12;
/// Number of frames over the largest gap of a pair: a larger gap shows wrong poses better, but fewer corners match.
const LARGEST_GAP_DIVISOR: usize = 4;
/// Gap up to which every frame has a pair; larger gaps start at fewer frames, so that matching takes linear time.
const MAX_DENSE_GAP: usize = 8;
/// Number of nearest cameras that a frame without a pair is matched with, because photos need not be in order.
const NUM_NEAREST: usize = 3;

/// Two frames with their matches, at least 20.
pub(crate) struct FramePair {
    pub frames: [usize; 2],
    pub matches: Vec<Correspondence>,
}

/// Matches the corners of frames 1, 2, 4, 8, .. apart, of every pair in short scenes. `None` stands for a frame that is
/// not compared.
pub(crate) fn match_frames(features: &[Option<Features>], cameras: &[Camera<IntrinsicsNorm>]) -> Vec<FramePair> {
    let num_frames = features.len();
    let matched = |frames: Vec<[usize; 2]>| -> Vec<FramePair> {
        frames.into_par_iter().filter_map(|frames| match_pair(features, cameras, frames)).collect()
    };
    let mut pairs = matched(pairs_in_order(num_frames));
    let mut is_matched = vec![false; num_frames];
    pairs.iter().flat_map(|pair| pair.frames).for_each(|frame| is_matched[frame] = true);
    let alone = (0..num_frames).filter(|frame| !is_matched[*frame] && num_frames > MAX_ALL_PAIRS);
    let mut nearest: Vec<[usize; 2]> = alone.flat_map(|frame| nearest_pairs(cameras, frame)).collect();
    nearest.sort_unstable();
    nearest.dedup();
    pairs.extend(matched(nearest));
    pairs
}

fn pairs_in_order(num_frames: usize) -> Vec<[usize; 2]> {
    let gaps: Vec<usize> = if num_frames <= MAX_ALL_PAIRS {
        (1..num_frames).collect()
    } else {
        std::iter::successors(Some(1), |gap| Some(2 * gap))
            .take_while(|gap| *gap <= num_frames / LARGEST_GAP_DIVISOR)
            .collect()
    };
    let of_gap = |gap: usize| {
        let step = (gap / MAX_DENSE_GAP).max(1);
        (0..num_frames - gap).step_by(step).map(move |frame| [frame, frame + gap])
    };
    gaps.into_iter().flat_map(of_gap).collect()
}

fn nearest_pairs(cameras: &[Camera<IntrinsicsNorm>], frame: usize) -> impl Iterator<Item = [usize; 2]> {
    let mut others: Vec<usize> = (0..cameras.len()).filter(|other| *other != frame).collect();
    // The distance of the centres plus three times the distance of the forward directions.
    let away = |other: &usize| {
        let (a, b) = (cameras[frame].c2w, cameras[*other].c2w);
        a.translation.distance(b.translation) + 3.0 * a.rotation.z_axis.distance(b.rotation.z_axis)
    };
    others.sort_by(|a, b| away(a).total_cmp(&away(b)));
    others.into_iter().take(NUM_NEAREST).map(move |other| [frame.min(other), frame.max(other)])
}

/// Matches the corners of two frames. Returns `None` if too few match, and for cameras with one centre, which have no
/// epipolar lines.
fn match_pair(
    features: &[Option<Features>],
    cameras: &[Camera<IntrinsicsNorm>],
    frames: [usize; 2],
) -> Option<FramePair> {
    let [first, second] = frames;
    if cameras[first].c2w.translation == cameras[second].c2w.translation {
        return None;
    }
    let matches = features[first].as_ref()?.matches(features[second].as_ref()?);
    (!matches.is_empty()).then_some(FramePair { frames, matches })
}

/// Returns at most `count` of the values, evenly spaced.
pub(crate) fn subsample<T: Copy>(values: &[T], count: usize) -> impl Iterator<Item = T> {
    let kept = values.len().min(count);
    (0..kept).map(move |index| values[index * values.len() / kept])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pairs_of_short_scenes_are_complete_and_of_long_ones_linear() {
        assert_eq!(pairs_in_order(3), [[0, 1], [1, 2], [0, 2]]);
        assert!(pairs_in_order(0).is_empty() && pairs_in_order(1).is_empty());
        let pairs = pairs_in_order(400);
        assert!(pairs.len() < 400 * 5, "{}", pairs.len());
        assert!(pairs.contains(&[0, 64]) && pairs.contains(&[8, 72]) && !pairs.contains(&[1, 65]));
        assert!((0..399).all(|frame| pairs.contains(&[frame, frame + 1])));
    }
}
