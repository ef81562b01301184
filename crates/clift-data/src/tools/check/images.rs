//! Checks of the images: readable, of equal size, distinct.

use std::collections::{BTreeMap, HashMap};
use std::hash::{DefaultHasher, Hash, Hasher};

use clift_core::{Camera, IntrinsicsNorm};
use rayon::prelude::*;

use crate::error::DataError;
use crate::scene_source::SceneSource;
use crate::tools::check::result::SceneCheck;
use crate::tools::features::image_features::Features;

/// Distance of two cameras over the extent of all centres above which equal images contradict the poses.
const MAX_MOVE: f64 = 0.02;
/// Angle between two cameras in degrees above which equal images contradict the poses.
const MAX_TURN_DEG: f64 = 1.0;

/// Columns and rows of every frame, `None` for an unreadable frame.
pub(crate) type Sizes = Vec<Option<[usize; 2]>>;

/// Decodes every frame, on all cores. Returns the sizes, and the corners of every `step`-th frame.
pub(crate) fn check_images(
    source: &dyn SceneSource,
    scene: usize,
    cameras: &[Camera<IntrinsicsNorm>],
    step: usize,
    check: &mut SceneCheck,
) -> (Sizes, Vec<Option<Features>>) {
    let read = (0..cameras.len()).into_par_iter().map(|frame| {
        source.check_frame(scene, frame)?;
        let image = source.frame(scene, frame)?;
        let mut hasher = DefaultHasher::new();
        image.rgb.hash(&mut hasher);
        let features = frame.is_multiple_of(step).then(|| Features::detect(&image));
        Ok(([image.width, image.height], hasher.finish(), features))
    });
    let read: Vec<Result<_, DataError>> = read.collect();
    let failures: Vec<(usize, String)> =
        read.iter().enumerate().filter_map(|(frame, read)| Some((frame, read.as_ref().err()?.to_string()))).collect();
    if let Some((_, first)) = failures.first() {
        let frames: Vec<usize> = failures.iter().map(|(frame, _)| *frame).collect();
        let frames = check.list_frames(&frames);
        check.reasons.push(format!("{frames} cannot be read; the first: {first}"));
    }
    let sizes: Sizes = read.iter().map(|read| Some(read.as_ref().ok()?.0)).collect();
    let mut counts: BTreeMap<[usize; 2], usize> = BTreeMap::new();
    sizes.iter().flatten().for_each(|size| *counts.entry(*size).or_default() += 1);
    check.image_size = counts.iter().max_by_key(|(_, count)| **count).map(|(size, _)| *size);
    if counts.len() > 1 {
        let list: Vec<String> =
            counts.iter().map(|([width, height], count)| format!("{width}x{height} ({count})")).collect();
        check.notes.push(format!("frames have {} sizes: {}", counts.len(), list.join(", ")));
    }
    let hashes: Vec<Option<u64>> = read.iter().map(|read| Some(read.as_ref().ok()?.1)).collect();
    check_repeated_images(&hashes, cameras, check);
    (sizes, read.into_iter().step_by(step).map(|read| read.ok()?.2).collect())
}

fn check_repeated_images(hashes: &[Option<u64>], cameras: &[Camera<IntrinsicsNorm>], check: &mut SceneCheck) {
    let distance = |a: usize, b: usize| cameras[a].c2w.translation.distance(cameras[b].c2w.translation);
    let extent = (0..cameras.len()).map(|frame| distance(0, frame)).fold(0.0, f64::max);
    let mut seen: HashMap<u64, usize> = HashMap::new();
    let (mut equal, mut contradictions) = (Vec::new(), Vec::new());
    for (frame, hash) in hashes.iter().enumerate() {
        let Some(hash) = hash else { continue };
        let Some(&first) = seen.get(hash) else {
            seen.insert(*hash, frame);
            continue;
        };
        let turn_deg = cameras[first].c2w.angle_to(cameras[frame].c2w).to_degrees();
        let is_moved = distance(first, frame) > MAX_MOVE * extent || turn_deg > MAX_TURN_DEG;
        (if is_moved { &mut contradictions } else { &mut equal }).push(frame);
    }
    if !contradictions.is_empty() {
        let frames = check.list_frames(&contradictions);
        check.reasons.push(format!("{frames} repeat the image of an earlier frame that has another camera"));
    }
    if !equal.is_empty() {
        let frames = check.list_frames(&equal);
        check.notes.push(format!("{frames} repeat the image and the camera of an earlier frame"));
    }
}
