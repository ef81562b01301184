//! Results of the check of one scene.

use serde::{Deserialize, Serialize};

/// Median symmetric epipolar distance above which a scene is flagged, in pixels of an image 640 columns wide.
pub const MAX_EPIPOLAR_PX: f64 = 1.0;

/// Results of the check of one scene.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SceneCheck {
    /// Key of the scene.
    pub key: String,
    /// Whether `reasons` is empty.
    pub ok: bool,
    /// Errors of the scene, empty if the scene passes.
    pub reasons: Vec<String>,
    /// Number of frames.
    pub num_frames: usize,
    /// Median symmetric epipolar distance of matched corners, in pixels of an image 640 columns wide; `None` if too few
    /// corners match.
    pub epipolar_px: Option<f64>,
    /// Observations that are no errors.
    pub notes: Vec<String>,
    /// Columns and rows of most frames.
    pub image_size: Option<[usize; 2]>,
    /// Widest field of view of any frame, in degrees.
    pub fov_deg: Option<f64>,
    /// Largest absolute entry of `R^T R - I` of any frame.
    pub rotation_defect: Option<f64>,
    /// Pairs of frames with matched corners.
    pub pairs: Vec<PairCheck>,
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
