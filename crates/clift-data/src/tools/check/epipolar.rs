//! Check of the poses against the images: matched corners must lie on each other's epipolar lines.

use std::sync::OnceLock;

use glam::DMat3;
use rayon::prelude::*;

use crate::geometry::camera::Camera;
use crate::image::rgb_image::RgbImage;
use crate::scene_source::SceneSource;
use crate::statistics::upper_median;
use crate::tools::check::drawing::epipolar_image;
use crate::tools::check::images::Sizes;
use crate::tools::check::result::{MAX_EPIPOLAR_PX, PairCheck, SceneCheck};
use crate::tools::features::epipolar::{Correspondence, epipolar_distance, fundamental_from_cameras};
use crate::tools::features::image_features::Features;

const NUM_PAIRS: usize = 9;
/// Frames of a scene over the gap of a pair, in order: a larger gap shows wrong poses better, but fewer corners match.
const GAP_DIVISORS: [usize; 4] = [6, 10, 16, 24];
/// Largest number of matches of one pair in the median of the scene, so that no pair dominates.
const MAX_MATCHES: usize = 150;
/// Smallest number of matches of a scene for a median.
const MIN_MATCHES: usize = 40;
/// Epipolar distance in pixels above which a note on a pair is added in a scene that passes.
const NOTED_PX: f64 = 3.0;

struct Pair {
    check: PairCheck,
    geometry: DMat3,
    matches: Vec<Correspondence>,
    distances: Vec<f64>,
}

/// Measures the epipolar distance of a scene. Returns an image of the pair nearest to the median of the scene.
pub(crate) fn check_poses(
    source: &dyn SceneSource,
    scene: usize,
    cameras: &[Camera],
    sizes: &Sizes,
    check: &mut SceneCheck,
) -> Option<RgbImage> {
    let features: Vec<OnceLock<Option<Features>>> = (0..cameras.len()).map(|_| OnceLock::new()).collect();
    let view = SceneViews { source, scene, cameras, sizes, features };
    let mut pairs: Vec<Pair> = view.anchors().into_par_iter().filter_map(|anchor| view.pair_from(anchor)).collect();
    // Two frames near the end of a scene may select each other.
    pairs.sort_by_key(|pair| pair.check.frames);
    pairs.dedup_by_key(|pair| pair.check.frames);
    check.pairs = pairs.iter().map(|pair| pair.check.clone()).collect();
    let pooled: Vec<f64> = pairs.iter().flat_map(|pair| subsample(&pair.distances, MAX_MATCHES)).collect();
    if pooled.len() < MIN_MATCHES {
        check.notes.push(format!(
            "poses were not compared with the images: only {} matching corners in {} pairs of frames",
            pooled.len(),
            pairs.len()
        ));
        return None;
    }
    let scene_px = upper_median(&pooled);
    check.epipolar_px = Some(scene_px);
    if scene_px > MAX_EPIPOLAR_PX {
        check.reasons.push(format!(
            "corners lie {scene_px:.2} px from their epipolar lines (median at 640 columns), more than \
             {MAX_EPIPOLAR_PX}: poses or intrinsics do not match the images"
        ));
    } else {
        for PairCheck { frames: [a, b], epipolar_px, .. } in &check.pairs {
            if *epipolar_px > NOTED_PX {
                check.notes.push(format!(
                    "frames {a} and {b}: {epipolar_px:.1} px; either their poses are wrong or a pattern repeats"
                ));
            }
        }
    }
    let off = |pair: &Pair| (pair.check.epipolar_px - scene_px).abs();
    let typical = pairs.iter().min_by(|a, b| off(a).total_cmp(&off(b)))?;
    view.plot(typical)
}

/// A scene with the features of the frames computed so far.
struct SceneViews<'a> {
    source: &'a dyn SceneSource,
    scene: usize,
    cameras: &'a [Camera],
    sizes: &'a Sizes,
    features: Vec<OnceLock<Option<Features>>>,
}

impl SceneViews<'_> {
    /// Returns the first frames of the pairs, spread over the scene.
    fn anchors(&self) -> Vec<usize> {
        let count = self.cameras.len().saturating_sub(1);
        let num_pairs = NUM_PAIRS.min(count);
        (0..num_pairs).map(|pair| pair * count / num_pairs).collect()
    }

    /// Returns the pair with the first partner whose corners match: from large to small gaps, then the frame of the most
    /// similar camera, because photos need not be in order.
    fn pair_from(&self, anchor: usize) -> Option<Pair> {
        let num_frames = self.cameras.len();
        let mut gaps: Vec<usize> = GAP_DIVISORS.iter().map(|divisor| num_frames / divisor).chain([2, 1]).collect();
        gaps.retain(|gap| *gap > 0);
        gaps.sort_unstable_by(|a, b| b.cmp(a));
        gaps.dedup();
        let in_order = gaps.into_iter().filter_map(|gap| {
            let after = anchor + gap;
            if after < num_frames { Some(after) } else { anchor.checked_sub(gap) }
        });
        let nearest = (0..num_frames).filter(|frame| *frame != anchor).min_by(|&a, &b| {
            let from_anchor = |frame: usize| dissimilarity(&self.cameras[anchor], &self.cameras[frame]);
            from_anchor(a).total_cmp(&from_anchor(b))
        });
        in_order.chain(nearest).find_map(|partner| self.pair([anchor.min(partner), anchor.max(partner)]))
    }

    /// Matches the corners of two frames. Returns `None` if no corners match.
    fn pair(&self, frames: [usize; 2]) -> Option<Pair> {
        let [a, b] = frames.map(|frame| &self.cameras[frame]);
        // Equal centres have no epipolar lines.
        if a.c2w.translation == b.c2w.translation {
            return None;
        }
        let [first, second] = frames;
        let sizes = [self.sizes[first]?, self.sizes[second]?];
        let matches = self.features(first)?.matches(self.features(second)?);
        if matches.is_empty() {
            return None;
        }
        let geometry = fundamental_from_cameras([a, b], sizes);
        let distances: Vec<f64> = matches.iter().map(|pair| epipolar_distance(&geometry, pair)).collect();
        let epipolar_px = upper_median(&distances);
        Some(Pair {
            check: PairCheck { frames, num_matches: matches.len(), epipolar_px },
            geometry,
            matches,
            distances,
        })
    }

    /// Returns the features of a frame, computed on first use; `None` for an unreadable frame.
    fn features(&self, frame: usize) -> Option<&Features> {
        let find = || Some(Features::detect(&self.source.frame(self.scene, frame).ok()?));
        self.features[frame].get_or_init(find).as_ref()
    }

    fn plot(&self, pair: &Pair) -> Option<RgbImage> {
        let [first, second] = pair.check.frames;
        let frames = [self.source.frame(self.scene, first).ok()?, self.source.frame(self.scene, second).ok()?];
        Some(epipolar_image(&frames, &pair.geometry, &pair.matches))
    }
}

/// Returns the distance of the centres plus three times the distance of the forward directions.
fn dissimilarity(a: &Camera, b: &Camera) -> f64 {
    let forward = a.c2w.rotation.z_axis.distance(b.c2w.rotation.z_axis);
    a.c2w.translation.distance(b.c2w.translation) + 3.0 * forward
}

/// Returns at most `count` of the values, evenly spaced.
fn subsample(values: &[f64], count: usize) -> impl Iterator<Item = f64> {
    let kept = values.len().min(count);
    (0..kept).map(move |index| values[index * values.len() / kept])
}
