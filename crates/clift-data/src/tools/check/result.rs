//! Results of the check of one scene.

use clift_core::plural;
use serde::{Deserialize, Serialize};

/// Median symmetric epipolar distance above which a scene is flagged, in pixels of an image 640 columns wide.
pub const MAX_EPIPOLAR_PX: f64 = 1.0;

/// Verdict on a scene.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, strum::Display, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// No error was found, and the poses were compared with the images.
    #[strum(to_string = "ok")]
    Ok,
    /// `reasons` lists errors.
    #[strum(to_string = "FLAGGED")]
    Flagged,
    /// No error was found, but too few corners match to compare the poses with the images.
    #[default]
    #[strum(to_string = "not compared")]
    NotCompared,
}

/// Results of the check of one scene.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SceneCheck {
    /// Key of the scene.
    pub key: String,
    /// Verdict.
    pub verdict: Verdict,
    /// Errors of the scene, empty if the scene passes.
    pub reasons: Vec<String>,
    /// Number of frames.
    pub num_frames: usize,
    /// Median symmetric epipolar distance of matched corners, in pixels of an image 640 columns wide; `None` if too few
    /// corners match.
    pub epipolar_px: Option<f64>,
    /// Observations that are not errors.
    pub notes: Vec<String>,
    /// Columns and rows of most frames.
    pub image_size: Option<[usize; 2]>,
    /// Widest field of view of any frame, in degrees.
    pub fov_deg: Option<f64>,
    /// Largest absolute entry of `R^T R - I` of any frame.
    pub rotation_defect: Option<f64>,
    /// Pairs of frames with matched corners.
    pub pairs: Vec<PairCheck>,
    /// Frames that share enough corners with two others. Empty if a mistake of all cameras was found.
    pub frames: Vec<FrameCheck>,
    /// File name of every frame; empty for frames without files of their own.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub frame_names: Vec<String>,
}

const MAX_NAMED: usize = 5;

impl SceneCheck {
    /// Returns the file name of a frame, or its position if it has no file.
    pub(crate) fn frame_name(&self, frame: usize) -> String {
        self.frame_names.get(frame).cloned().unwrap_or_else(|| frame.to_string())
    }

    /// Formats frames as `3 frames (1, 4, 7)`, with dots after the fifth.
    pub(crate) fn list_frames(&self, frames: &[usize]) -> String {
        let list: Vec<String> = frames.iter().take(MAX_NAMED).map(|&frame| self.frame_name(frame)).collect();
        let more = if frames.len() > MAX_NAMED { ", .." } else { "" };
        format!("{} ({}{more})", plural(frames.len(), "frame"), list.join(", "))
    }

    pub(crate) fn judge(&mut self) {
        self.verdict = match (self.reasons.is_empty(), self.epipolar_px) {
            (false, _) => Verdict::Flagged,
            (true, Some(_)) => Verdict::Ok,
            (true, None) => Verdict::NotCompared,
        };
    }
}

/// Two frames with matched corners.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PairCheck {
    /// Positions of the frames.
    pub frames: [usize; 2],
    /// Number of matched corners.
    pub num_matches: usize,
    /// Median of their symmetric epipolar distances, in pixels of an image 640 columns wide.
    pub epipolar_px: f64,
}

/// A frame whose corners two other frames place.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FrameCheck {
    /// Position of the frame.
    pub frame: usize,
    /// Distance of its corners from where two other frames place them, in pixels of an image 640 columns wide: the median
    /// over the corners, and the lower quartile over at most six choices of the two.
    pub reprojection_px: f64,
}
