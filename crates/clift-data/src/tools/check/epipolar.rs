//! Check of the poses against the images: matched corners must lie on each other's epipolar lines, and where other frames
//! place them.

use std::fmt;

use clift_core::{Camera, IntrinsicsNorm, median, plural};
use glam::{DMat3, DVec3};

use crate::tools::check::frames::{
    exchange_neighbours, find_triplets, frame_distances, triplet_distances, wrong_frames,
};
use crate::tools::check::images::Sizes;
use crate::tools::check::matches::{FramePair, match_frames, subsample};
use crate::tools::check::result::{FrameCheck, MAX_EPIPOLAR_PX, PairCheck, SceneCheck};
use crate::tools::features::epipolar::{PixelCamera, epipolar_distance};
use crate::tools::features::image_features::Features;

/// Largest number of matches of one pair in the median of the scene, so that no pair dominates.
const MAX_MATCHES: usize = 150;
const MIN_MATCHES: usize = 40;
/// Epipolar distance of changed cameras over that of the given ones, in the median over pairs, below which the change is
/// a mistake of the scene. Right cameras of eight real scenes gave at least 1.03 (docs/guide/data.md).
const MAX_MISTAKE_RATIO: f64 = 0.93;
/// Smallest share of the pairs in which the changed cameras fit better.
const MIN_MISTAKE_SHARE: f64 = 0.6;

/// Compares the poses of every `step`-th frame of a scene with the images. `features` are the corners of these frames,
/// `None` for an unreadable one.
pub(crate) fn check_poses(
    cameras: &[Camera<IntrinsicsNorm>],
    sizes: &Sizes,
    step: usize,
    features: &[Option<Features>],
    check: &mut SceneCheck,
) {
    let cameras: Vec<Camera<IntrinsicsNorm>> = cameras.iter().copied().step_by(step).collect();
    let sizes = sizes.iter().step_by(step);
    // The camera of an unreadable frame is not used.
    let view = |(camera, size): (&Camera<IntrinsicsNorm>, &Option<[usize; 2]>)| {
        PixelCamera::new(camera, size.unwrap_or([1, 1]))
    };
    let views: Vec<PixelCamera> = cameras.iter().zip(sizes).map(view).collect();
    let pairs = match_frames(features, &cameras);
    let distances: Vec<Vec<f64>> = pairs.iter().map(|pair| epipolar_distances(&views, pair)).collect();
    let pair_check = |(pair, distances): (&FramePair, &Vec<f64>)| PairCheck {
        frames: pair.frames.map(|frame| frame * step),
        num_matches: distances.len(),
        epipolar_px: median(distances),
    };
    check.pairs = pairs.iter().zip(&distances).map(pair_check).collect();
    let pooled: Vec<f64> = distances.iter().flat_map(|distances| subsample(distances, MAX_MATCHES)).collect();
    if pooled.len() < MIN_MATCHES {
        let (count, pairs) = (plural(pooled.len(), "matching corner"), plural(pairs.len(), "pair"));
        check.notes.push(format!("poses were not compared with the images: only {count} in {pairs} of frames"));
        return;
    }
    let scene_px = median(&pooled);
    check.epipolar_px = Some(scene_px);
    if scene_px > MAX_EPIPOLAR_PX {
        check.reasons.push(format!(
            "corners lie {scene_px:.2} px from their epipolar lines (median at 640 columns), more than \
             {MAX_EPIPOLAR_PX}: poses or intrinsics do not match the images"
        ));
    }
    match find_mistake(&views, &pairs) {
        Some((mistake, px)) => check.reasons.push(format!(
            "the images fit better with {mistake}: the median epipolar distance is {px:.2} px instead of {scene_px:.2}"
        )),
        None => check_frames(views, &pairs, step, check),
    }
}

/// Judges each frame by the corners that it shares with two others.
fn check_frames(mut views: Vec<PixelCamera>, pairs: &[FramePair], step: usize, check: &mut SceneCheck) {
    let triplets = find_triplets(views.len(), pairs);
    let distances = frame_distances(&triplets, &triplet_distances(&views, &triplets), &[]);
    let alone: Vec<usize> =
        (0..views.len()).filter(|frame| distances[*frame].is_none()).map(|frame| frame * step).collect();
    let known = distances.iter().enumerate();
    check.frames =
        known.filter_map(|(frame, px)| Some(FrameCheck { frame: frame * step, reprojection_px: (*px)? })).collect();
    if !alone.is_empty() {
        let frames = check.list_frames(&alone);
        check.notes.push(format!("{frames} were not compared with two others: too few corners in common"));
    }
    for (frame, [given, new]) in exchange_neighbours(&mut views, &triplets) {
        let [first, second] = [frame, frame + 1].map(|frame| check.frame_name(frame * step));
        check.reasons.push(format!(
            "the cameras of frames {first} and {second} are exchanged: the other frames place corners {given:.1} px away, \
             with the cameras exchanged {new:.1} px"
        ));
    }
    let wrong = wrong_frames(&views, &triplets);
    if let Some(worst) = wrong.iter().map(|(_, px)| *px).reduce(f64::max) {
        let mut frames: Vec<usize> = wrong.iter().map(|(frame, _)| frame * step).collect();
        frames.sort_unstable();
        let typical = median(&check.frames.iter().map(|frame| frame.reprojection_px).collect::<Vec<f64>>());
        check.reasons.push(format!(
            "the cameras of {} do not fit the other frames, which place corners up to {worst:.1} px away (median of all \
             frames {typical:.1})",
            check.list_frames(&frames)
        ));
    }
}

fn epipolar_distances(views: &[PixelCamera], FramePair { frames: [a, b], matches }: &FramePair) -> Vec<f64> {
    let geometry = PixelCamera::fundamental(&views[*a], &views[*b]);
    matches.iter().map(|pair| epipolar_distance(&geometry, pair)).collect()
}

/// Returns the mistake whose correction fits the images best and clearly better than the given cameras, with the median
/// epipolar distance after the correction.
fn find_mistake(views: &[PixelCamera], pairs: &[FramePair]) -> Option<(Mistake, f64)> {
    let pairs: Vec<FramePair> = pairs
        .iter()
        .map(|pair| FramePair { frames: pair.frames, matches: subsample(&pair.matches, MAX_MATCHES).collect() })
        .collect();
    let distances =
        |views: &[PixelCamera]| -> Vec<Vec<f64>> { pairs.iter().map(|pair| epipolar_distances(views, pair)).collect() };
    let medians = |distances: &[Vec<f64>]| -> Vec<f64> { distances.iter().map(|values| median(values)).collect() };
    let given = medians(&distances(views));
    let tried = Mistake::all().filter_map(|mistake| {
        let corrected: Vec<PixelCamera> = views.iter().map(|camera| mistake.corrected(camera)).collect();
        let distances = distances(&corrected);
        let ratios: Vec<f64> = medians(&distances).iter().zip(&given).map(|(new, given)| new / given).collect();
        let num_better = ratios.iter().filter(|ratio| **ratio < 1.0).count();
        let is_usual = num_better as f64 >= MIN_MISTAKE_SHARE * ratios.len() as f64;
        let ratio = median(&ratios);
        (ratio < MAX_MISTAKE_RATIO && is_usual).then(|| (ratio, mistake, median(&distances.concat())))
    });
    tried.min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, mistake, px)| (mistake, px))
}

const FOCAL_SCALES: [f64; 4] = [0.8, 0.9, 1.1, 1.25];
const TURNS_DEG: [f64; 2] = [2.0, 4.0];

/// A change of every camera that undoes a usual mistake. Prints what the files hold.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Mistake {
    /// OpenGL's axes (y up, z backward) for OpenCV's, or the reverse.
    Axes,
    /// `w2c` for `c2w`, or the reverse.
    Inverse,
    /// Both: `w2c` with OpenGL's axes.
    InverseAndAxes,
    /// Focal lengths that fit better after this factor.
    Focal(f64),
    /// Cameras that fit better after this turn about an axis of their own, in degrees.
    Turn([i8; 3], f64),
}

impl Mistake {
    pub fn all() -> impl Iterator<Item = Self> {
        let axes =
            (0..27).map(|index| [index / 9 - 1, index / 3 % 3 - 1, index % 3 - 1]).filter(|axis| *axis != [0; 3]);
        let turns = axes.flat_map(|axis| TURNS_DEG.map(|angle_deg| Self::Turn(axis, angle_deg)));
        [Self::Axes, Self::Inverse, Self::InverseAndAxes].into_iter().chain(FOCAL_SCALES.map(Self::Focal)).chain(turns)
    }

    pub fn corrected(self, camera: &PixelCamera) -> PixelCamera {
        let mut camera = *camera;
        let opposite_axes = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
        match self {
            Self::Axes => camera.c2w.rotation *= opposite_axes,
            Self::Inverse => camera.c2w = camera.c2w.inverse(),
            Self::InverseAndAxes => {
                camera.c2w = camera.c2w.inverse();
                camera.c2w.rotation *= opposite_axes;
            }
            Self::Focal(scale) => camera = camera.with_focal_scale(scale),
            Self::Turn(axis, angle_deg) => {
                let axis = DVec3::from_array(axis.map(f64::from)).normalize();
                camera.c2w.rotation *= DMat3::from_axis_angle(axis, angle_deg.to_radians());
            }
        }
        camera
    }
}

impl fmt::Display for Mistake {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Axes => {
                write!(f, "the y and z axes of every camera reversed (OpenGL's axes for OpenCV's, or the reverse)")
            }
            Self::Inverse => write!(f, "every pose inverted (world-to-camera for camera-to-world, or the reverse)"),
            Self::InverseAndAxes => {
                write!(f, "every pose inverted, then its y and z axes reversed (OpenGL's view matrices)")
            }
            Self::Focal(scale) => write!(f, "focal lengths times {scale}"),
            Self::Turn([x, y, z], angle_deg) => {
                write!(f, "every camera turned by {angle_deg} degrees about its own axis ({x}, {y}, {z})")
            }
        }
    }
}
