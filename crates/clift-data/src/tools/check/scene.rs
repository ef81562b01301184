//! Checks of one scene: images, cameras, and poses against the images.

use std::collections::BTreeMap;

use clift_core::plural;

use crate::scene_source::SceneSource;
use crate::skip_report::SkipReport;
use crate::sources::test_scenes::KEPT_FOR_TESTING;
use crate::tools::check::result::SceneCheck;
use crate::tools::check::{cameras, epipolar, images};

/// Largest number of frames whose poses are compared with the images, evenly spaced: the corners of a frame take 0.4 MB.
const MAX_COMPARED: usize = 500;

/// Checks one scene of `source`. Every failure is a reason in the result.
///
/// Decodes all frames, and compares each with about eight others, on all cores.
pub fn check_scene(source: &dyn SceneSource, scene: usize) -> SceneCheck {
    let mut check = SceneCheck { key: source.key(scene).to_owned(), ..SceneCheck::default() };
    let cameras = match source.cameras(scene) {
        Ok(cameras) => cameras,
        Err(error) => {
            check.reasons.push(error.to_string());
            check.judge();
            return check;
        }
    };
    check.num_frames = cameras.len();
    // Without names the findings have positions.
    check.frame_names = source.frame_names(scene).unwrap_or_default();
    let step = cameras.len().div_ceil(MAX_COMPARED).max(1);
    if step > 1 {
        check.notes.push(format!("poses were compared with the images of every {step}. frame"));
    }
    let (sizes, features) = images::check_images(source, scene, &cameras, step, &mut check);
    cameras::check_cameras(&cameras, &sizes, &mut check);
    epipolar::check_poses(&cameras, &sizes, step, &features, &mut check);
    check.judge();
    check
}

/// Returns results for the scenes skipped when the source was opened, except those reserved for testing.
pub fn skipped_scenes(report: &SkipReport) -> Vec<SceneCheck> {
    let skips = report.skips.iter().filter(|skip| skip.reason != KEPT_FOR_TESTING);
    let flagged = skips.map(|skip| {
        let mut check = SceneCheck { key: skip.key.clone(), ..SceneCheck::default() };
        check.reasons.push(skip.reason.clone());
        check.judge();
        note_skipped_frames(report, &mut check);
        check
    });
    flagged.collect()
}

/// Adds a note for the frames of a scene skipped when the source was opened.
pub fn note_skipped_frames(report: &SkipReport, check: &mut SceneCheck) {
    let mut by_reason: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    for skip in report.frames.iter().filter(|skip| skip.key == check.key) {
        by_reason.entry(&skip.reason).or_default().push(&skip.frame);
    }
    for (reason, names) in by_reason {
        check.notes.push(format!("{} skipped, {reason}: {}", plural(names.len(), "frame"), names.join(", ")));
    }
}

#[cfg(test)]
mod tests;
