//! Each frame against the others: exchanged neighbours, and single cameras that do not fit.

use clift_core::median;

use crate::tools::check::triplets::Triplet;
use crate::tools::features::pixel_camera::PixelCamera;

/// Reprojection distance of a frame above which its camera is wrong, in pixels of an image 640 columns wide.
const MAX_FRAME_PX: f64 = 2.5;
/// The same over the median of all frames: noisy poses are a property of the scene.
const MAX_FRAME_RATIO: f64 = 3.5;
/// Reprojection distance of two exchanged cameras over that of the given ones, below which they are exchanged.
const MAX_EXCHANGED_RATIO: f64 = 0.85;
/// Smallest share of the triplets in which the exchanged cameras fit better.
const MIN_EXCHANGED_SHARE: f64 = 0.6;
/// Frames over the largest number of wrong frames that are listed one by one.
const MIN_FRAMES_PER_WRONG: usize = 4;

/// Smallest number of triplets by which a frame is judged: one or two may match a repeating pattern with itself.
const MIN_TRIPLETS: usize = 3;

/// Two neighbours whose cameras fit better when they are exchanged.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Exchanged {
    /// The first of the two frames.
    pub frame: usize,
    /// Median reprojection distance of both, in pixels, as given and exchanged.
    pub px: [f64; 2],
}

/// Exchanges neighbours in `cameras` as long as they fit better, the clearest first.
pub(crate) fn exchange_neighbours(cameras: &mut [PixelCamera], triplets: &[Vec<Triplet>]) -> Vec<Exchanged> {
    let mut found = Vec::new();
    while found.len() <= cameras.len() / MIN_FRAMES_PER_WRONG {
        let tried = (1..cameras.len()).filter_map(|second| exchanged(cameras, triplets, second - 1));
        let ratio = |exchanged: &Exchanged| exchanged.px[1] / exchanged.px[0];
        let best = tried.min_by(|a, b| ratio(a).total_cmp(&ratio(b)));
        let Some(best) = best.filter(|best| ratio(best) < MAX_EXCHANGED_RATIO) else { break };
        cameras.swap(best.frame, best.frame + 1);
        found.push(best);
    }
    found
}

/// Exchanges the cameras of a frame and the next. Returns `None` if most triplets fit worse.
fn exchanged(cameras: &[PixelCamera], triplets: &[Vec<Triplet>], frame: usize) -> Option<Exchanged> {
    let mut changed = cameras.to_vec();
    changed.swap(frame, frame + 1);
    let concerned = || triplets[frame].iter().chain(&triplets[frame + 1]);
    let distances =
        |cameras: &[PixelCamera]| -> Vec<f64> { concerned().map(|triplet| triplet.reprojection_px(cameras)).collect() };
    let (given, new) = (distances(cameras), distances(&changed));
    let num_better = given.iter().zip(&new).filter(|(given, new)| new < given).count();
    (num_better > 0 && num_better as f64 >= MIN_EXCHANGED_SHARE * given.len() as f64)
        .then(|| Exchanged { frame, px: [median(&given), median(&new)] })
}

/// Returns the reprojection distance of every triplet, by frame.
pub(crate) fn triplet_distances(cameras: &[PixelCamera], triplets: &[Vec<Triplet>]) -> Vec<Vec<f64>> {
    let of_frame = |triplets: &Vec<Triplet>| triplets.iter().map(|triplet| triplet.reprojection_px(cameras)).collect();
    triplets.iter().map(of_frame).collect()
}

/// Returns the reprojection distance of every frame in pixels, the lower quartile of its triplets without those that
/// `wrong` frames place; `None` for a frame with too few.
pub(crate) fn frame_distances(triplets: &[Vec<Triplet>], distances: &[Vec<f64>], wrong: &[usize]) -> Vec<Option<f64>> {
    let of_frame = |(triplets, distances): (&Vec<Triplet>, &Vec<f64>)| {
        let is_right = |triplet: &Triplet| !triplet.others.iter().any(|frame| wrong.contains(frame));
        let right = triplets.iter().zip(distances).filter(|(triplet, _)| is_right(triplet));
        let mut right: Vec<f64> = right.map(|(_, px)| *px).collect();
        if right.len() < MIN_TRIPLETS {
            return None;
        }
        right.sort_by(f64::total_cmp);
        right.get((right.len() - 1) / 4).copied()
    };
    triplets.iter().zip(distances).map(of_frame).collect()
}

/// Returns the frames whose cameras do not fit the others, each with its reprojection distance in pixels.
///
/// A wrong frame also misplaces the points of its neighbours. Of the frames that do not fit, the one without which most
/// others fit is wrong first, and no longer places points.
pub(crate) fn wrong_frames(cameras: &[PixelCamera], triplets: &[Vec<Triplet>]) -> Vec<(usize, f64)> {
    let distances = triplet_distances(cameras, triplets);
    let (mut wrong, mut names): (Vec<(usize, f64)>, Vec<usize>) = (Vec::new(), Vec::new());
    while wrong.len() <= cameras.len() / MIN_FRAMES_PER_WRONG {
        let known: Vec<f64> = frame_distances(triplets, &distances, &names).into_iter().flatten().collect();
        let bound = MAX_FRAME_PX.max(MAX_FRAME_RATIO * median(&known));
        let suspects = |names: &[usize]| -> Vec<(usize, f64)> {
            let found = frame_distances(triplets, &distances, names).into_iter().enumerate();
            let found = found.filter_map(|(frame, px)| Some((frame, px?)));
            found.filter(|(frame, px)| *px > bound && !names.contains(frame)).collect()
        };
        let left_without = |frame: usize| suspects(&[&names[..], &[frame]].concat()).len();
        let suspected = suspects(&names).into_iter().map(|(frame, px)| (left_without(frame), frame, px));
        let worst = suspected.min_by(|a, b| a.0.cmp(&b.0).then(b.2.total_cmp(&a.2)));
        let Some((_, frame, px)) = worst else { break };
        names.push(frame);
        wrong.push((frame, px));
    }
    wrong
}
