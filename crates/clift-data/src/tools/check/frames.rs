//! Each frame against the others: exchanged neighbours, and single cameras that do not fit.

use std::collections::HashMap;

use clift_core::median;
use glam::DVec3;

use crate::tools::check::matches::{FramePair, subsample};
use crate::tools::features::epipolar::PixelCamera;

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

/// The first of two neighbours, and the median reprojection distance of both, in pixels, as given and exchanged.
type Exchanged = (usize, [f64; 2]);

/// Exchanges neighbours in `cameras` as long as they fit better, the clearest first.
pub(crate) fn exchange_neighbours(cameras: &mut [PixelCamera], triplets: &[Vec<Triplet>]) -> Vec<Exchanged> {
    let mut found = Vec::new();
    while found.len() <= cameras.len() / MIN_FRAMES_PER_WRONG {
        let tried = (1..cameras.len()).filter_map(|second| exchanged(cameras, triplets, second - 1));
        let ratio = |(_, [given, new]): &Exchanged| new / given;
        let best = tried.min_by(|a, b| ratio(a).total_cmp(&ratio(b)));
        let Some(best) = best.filter(|best| ratio(best) < MAX_EXCHANGED_RATIO) else { break };
        cameras.swap(best.0, best.0 + 1);
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
        .then(|| (frame, [median(&given), median(&new)]))
}

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

const MAX_TRIPLETS: usize = 6;
const MIN_CORNERS: usize = 15;
const MAX_CORNERS: usize = 150;
/// Frames to the nearer of the two others above which a larger gap is no longer preferred.
const ENOUGH_GAP: usize = 4;

/// A frame, two others, and the corners that all three show.
pub(crate) struct Triplet {
    pub frame: usize,
    /// The frames that place the points.
    pub others: [usize; 2],
    /// Corners in the others and in the frame.
    corners: Vec<[[f64; 2]; 3]>,
}

impl Triplet {
    /// Returns the median distance of the corners from where the others place them, in pixels.
    pub fn reprojection_px(&self, cameras: &[PixelCamera]) -> f64 {
        let [first, second] = self.others.map(|frame| &cameras[frame]);
        let judged = &cameras[self.frame];
        let distance = |[a, b, seen]: &[[f64; 2]; 3]| {
            let [x, y] = transferred([first, second, judged], *a, *b)?;
            Some((x - seen[0]).hypot(y - seen[1]))
        };
        // A point that cannot be projected is as far away as it can be.
        let distances = self.corners.iter().map(|corners| distance(corners).unwrap_or(f64::INFINITY));
        median(&distances.collect::<Vec<f64>>())
    }
}

/// A frame that matches another, with its corners by the bits of the corners of the other, which are equal in every pair.
type Partner = (usize, HashMap<[u64; 2], [f64; 2]>);

/// Selects for each frame the triplets with many corners and wide gaps, best first.
pub(crate) fn find_triplets(num_frames: usize, pairs: &[FramePair]) -> Vec<Vec<Triplet>> {
    let mut partners: Vec<Vec<Partner>> = (0..num_frames).map(|_| Vec::new()).collect();
    let bits = |corner: [f64; 2]| corner.map(f64::to_bits);
    for FramePair { frames: [first, second], matches } in pairs {
        let forward = matches.iter().map(|pair| (bits(pair.first), pair.second)).collect();
        let backward = matches.iter().map(|pair| (bits(pair.second), pair.first)).collect();
        partners[*first].push((*second, forward));
        partners[*second].push((*first, backward));
    }
    let of_frame = |(frame, partners): (usize, Vec<Partner>)| {
        let mut triplets = Vec::new();
        for (position, (a, in_a)) in partners.iter().enumerate() {
            for (b, in_b) in &partners[position + 1..] {
                let common = in_a
                    .iter()
                    .filter_map(|(seen, corner)| Some([*corner, *in_b.get(seen)?, seen.map(f64::from_bits)]));
                let mut corners: Vec<[[f64; 2]; 3]> = common.collect();
                if corners.len() < MIN_CORNERS {
                    continue;
                }
                corners.sort_by(|p, q| p[2][0].total_cmp(&q[2][0]).then(p[2][1].total_cmp(&q[2][1])));
                let gap = a.abs_diff(frame).min(b.abs_diff(frame));
                let is_between = (*a < frame) != (*b < frame);
                let weight = corners.len() * (gap + 2 * usize::from(is_between)).min(ENOUGH_GAP);
                let corners = subsample(&corners, MAX_CORNERS).collect();
                triplets.push((weight, Triplet { frame, others: [*a, *b], corners }));
            }
        }
        triplets.sort_by_key(|(weight, triplet)| (std::cmp::Reverse(*weight), triplet.others));
        triplets.into_iter().take(MAX_TRIPLETS).map(|(_, triplet)| triplet).collect()
    };
    partners.into_iter().enumerate().map(of_frame).collect()
}

/// Places a point by its corners `a` and `b` in two frames, and projects it into a third. A point at infinity is
/// projected too. Returns `None` for a point in the plane of the third camera.
fn transferred([first, second, third]: [&PixelCamera; 3], a: [f64; 2], b: [f64; 2]) -> Option<[f64; 2]> {
    let ray = first.ray(a);
    // Homogeneous pixels of the point with inverse depth `s` on the ray are `direction + s * origin`.
    let along = |camera: &PixelCamera| [camera.project_direction(ray), camera.project(first.c2w.translation)];
    let [direction, origin] = along(second);
    let residual = |pixel: DVec3| [b[0] * pixel.z - pixel.x, b[1] * pixel.z - pixel.y];
    let (offset, slope) = (residual(direction), residual(origin));
    let square = slope[0] * slope[0] + slope[1] * slope[1];
    let s = if square > 0.0 { -(offset[0] * slope[0] + offset[1] * slope[1]) / square } else { 0.0 };
    let [direction, origin] = along(third);
    let pixel = direction + s * origin;
    let seen = [pixel.x / pixel.z, pixel.y / pixel.z];
    seen.iter().all(|value| value.is_finite()).then_some(seen)
}
