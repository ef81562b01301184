//! Check of the poses against the images: matched corners must lie on each other's epipolar lines, and where other frames
//! place them.

use clift_core::{Camera, IntrinsicsNorm, RgbImage, median};

use crate::scene_source::SceneSource;
use crate::skip_report::plural;
use crate::tools::check::drawing::epipolar_image;
use crate::tools::check::frames::{exchange_neighbours, frame_distances, triplet_distances, wrong_frames};
use crate::tools::check::images::Sizes;
use crate::tools::check::matches::{FramePair, match_frames, subsample};
use crate::tools::check::mistakes::Mistake;
use crate::tools::check::result::{FrameCheck, MAX_EPIPOLAR_PX, PairCheck, SceneCheck};
use crate::tools::check::triplets::find_triplets;
use crate::tools::features::epipolar::epipolar_distance;
use crate::tools::features::image_features::Features;
use crate::tools::features::pixel_camera::PixelCamera;

/// Largest number of matches of one pair in the median of the scene, so that no pair dominates.
const MAX_MATCHES: usize = 150;
/// Smallest number of matches of a scene for a median.
const MIN_MATCHES: usize = 40;
/// Epipolar distance in pixels above which a note on a pair is added in a scene that passes.
const NOTED_PX: f64 = 3.0;
/// Epipolar distance of changed cameras over that of the given ones, in the median over pairs, below which the change is
/// a mistake of the scene. Right cameras of eight real scenes gave at least 1.03 (docs/guide/data.md).
const MAX_MISTAKE_RATIO: f64 = 0.93;
/// Smallest share of the pairs in which the changed cameras fit better.
const MIN_MISTAKE_SHARE: f64 = 0.6;

/// Frames whose poses are compared with the images.
pub(crate) struct Compared<'a> {
    /// Positions in the scene from one frame to the next.
    pub step: usize,
    /// Cameras of all frames of the scene.
    pub cameras: &'a [Camera<IntrinsicsNorm>],
    /// Sizes of all frames of the scene.
    pub sizes: &'a Sizes,
    /// Corners of the compared frames, `None` for an unreadable one.
    pub features: Vec<Option<Features>>,
}

/// Compares the poses of a scene with its images. Returns an image of the pair nearest to the median of the scene.
pub(crate) fn check_poses(
    source: &dyn SceneSource,
    scene: usize,
    compared: &Compared,
    check: &mut SceneCheck,
) -> Option<RgbImage> {
    let &Compared { step, cameras, sizes, .. } = compared;
    let cameras: Vec<Camera<IntrinsicsNorm>> = cameras.iter().copied().step_by(step).collect();
    let sizes = sizes.iter().step_by(step);
    // The camera of an unreadable frame is not used.
    let view = |(camera, size): (&Camera<IntrinsicsNorm>, &Option<[usize; 2]>)| {
        PixelCamera::new(camera, size.unwrap_or([1, 1]))
    };
    let views: Vec<PixelCamera> = cameras.iter().zip(sizes).map(view).collect();
    let pairs = match_frames(&compared.features, &cameras);
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
        return None;
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
        None => check_frames(views.clone(), &pairs, step, check),
    }
    note_pairs(check);
    let off = |(_, pair): &(usize, &PairCheck)| (pair.epipolar_px - scene_px).abs();
    let (typical, _) = check.pairs.iter().enumerate().min_by(|a, b| off(a).total_cmp(&off(b)))?;
    let FramePair { frames: [first, second], matches } = &pairs[typical];
    let images = [source.frame(scene, first * step).ok()?, source.frame(scene, second * step).ok()?];
    Some(epipolar_image(&images, &PixelCamera::fundamental(&views[*first], &views[*second]), matches))
}

/// Adds a note on pairs with large distances in a scene that passes.
fn note_pairs(check: &mut SceneCheck) {
    let far: Vec<&PairCheck> = check.pairs.iter().filter(|pair| pair.epipolar_px > NOTED_PX).collect();
    if let Some(PairCheck { frames, epipolar_px, .. }) = far.first().filter(|_| check.reasons.is_empty()) {
        let [a, b] = frames.map(|frame| check.frame_name(frame));
        let pairs = plural(far.len(), "pair");
        check.notes.push(format!(
            "{pairs} of frames above {NOTED_PX} px, the first {a} and {b} with {epipolar_px:.1} px: a pattern repeats, or \
             their poses are wrong"
        ));
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
    for exchanged in exchange_neighbours(&mut views, &triplets) {
        let [given, new] = exchanged.px;
        let [first, second] = [exchanged.frame, exchanged.frame + 1].map(|frame| check.frame_name(frame * step));
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

/// Returns the epipolar distances of the matches of a pair, in pixels.
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
