//! Whether scenes can be believed: readable pictures, plausible cameras, and poses that agree with the pictures.

mod cameras;
mod epipolar;
mod frames;
mod picture;

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::clip::{Frame, SceneSource};
use crate::ledger::Ledger;
use crate::test_scenes::KEPT_FOR_TESTING;
pub use epipolar::PairCheck;

/// Median symmetric epipolar distance above which a scene is flagged, in pixels of a picture 640 wide.
pub const MAX_EPIPOLAR_PX: f64 = 1.0;

/// What was found about one scene.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SceneCheck {
    /// Key of the scene.
    pub key: String,
    /// Whether there is no reason against it.
    pub ok: bool,
    /// What is wrong with it.
    pub reasons: Vec<String>,
    /// Frames it has.
    pub num_frames: usize,
    /// Median symmetric epipolar distance of matched corners, in pixels of a picture 640 wide; `None` where too few
    /// corners match.
    pub epipolar_px: Option<f64>,
    /// What is worth knowing but not wrong.
    pub notes: Vec<String>,
    /// Columns and rows of most frames.
    pub image_size: Option<[usize; 2]>,
    /// Widest field of view of any frame, in degrees.
    pub fov_deg: Option<f64>,
    /// Largest absolute entry of `R^T R - I` of any frame.
    pub rotation_defect: Option<f64>,
    /// Frames whose corners were matched, in pairs.
    pub pairs: Vec<PairCheck>,
}

/// One scene's check, with a picture to look at.
#[derive(Clone, Debug, PartialEq)]
pub struct Checked {
    /// What was found.
    pub check: SceneCheck,
    /// Two frames with epipolar lines: a dot of one colour is the same corner in both, and must lie on the line of its
    /// colour. `None` where too few corners match.
    pub picture: Option<Frame>,
}

/// Checks one scene of `source`. What fails is a reason in the result and never an error.
///
/// All frames are decoded, on all cores, and about nine pairs of them compared.
pub fn check_scene(source: &dyn SceneSource, scene: usize) -> Checked {
    let mut check = SceneCheck { key: source.key(scene).to_owned(), ..SceneCheck::default() };
    let cameras = match source.cameras(scene) {
        Ok(cameras) => cameras,
        Err(error) => {
            check.reasons.push(error.to_string());
            return Checked { check, picture: None };
        }
    };
    check.num_frames = cameras.len();
    let frames = frames::look(source, scene, &cameras, &mut check);
    cameras::look(&cameras, &frames, &mut check);
    let picture = epipolar::look(source, scene, &cameras, &frames, &mut check);
    check.ok = check.reasons.is_empty();
    Checked { check, picture }
}

/// The scenes that opening a source left out, as flagged ones; without those that belong to the test half.
pub fn left_out(ledger: &Ledger) -> Vec<SceneCheck> {
    let skips = ledger.skips.iter().filter(|skip| skip.reason != KEPT_FOR_TESTING);
    let flagged = skips.map(|skip| {
        let mut check = SceneCheck { key: skip.key.clone(), ..SceneCheck::default() };
        check.reasons.push(skip.reason.clone());
        note_frames(ledger, &mut check);
        check
    });
    flagged.collect()
}

/// Names every frame that opening the source left out of a scene.
pub fn note_frames(ledger: &Ledger, check: &mut SceneCheck) {
    let mut by_reason: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    for skip in ledger.frames.iter().filter(|skip| skip.key == check.key) {
        by_reason.entry(&skip.reason).or_default().push(&skip.frame);
    }
    for (reason, names) in by_reason {
        let frames = if names.len() == 1 { "frame" } else { "frames" };
        check.notes.push(format!("{} {frames} left out, {reason}: {}", names.len(), names.join(", ")));
    }
}

#[cfg(test)]
mod tests;
