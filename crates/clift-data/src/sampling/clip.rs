//! View indices, posed views and clips.

use serde::{Deserialize, Serialize};

use clift_core::{Intrinsics, Pose};

/// Context and target frames of a scene, as positions in the list of frames. Further fields of published evaluation indices are
/// ignored.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct ViewIndices {
    /// Frames for the encoder.
    pub context: Vec<usize>,
    /// Frames to render.
    pub target: Vec<usize>,
}

impl ViewIndices {
    /// Returns the number of targets that are also contexts. The input holds the image of such a target.
    pub fn num_context_targets(&self) -> usize {
        self.target.iter().filter(|frame| self.context.contains(frame)).count()
    }
}

/// Posed views of one scene at the model's resolution, in the scene's normalised frame.
#[derive(Clone, Debug, PartialEq)]
pub struct ClipViews {
    /// Columns of every view.
    pub width: usize,
    /// Rows of every view.
    pub height: usize,
    /// `[num_views, height, width, 3]`, 8-bit RGB.
    pub images: Vec<u8>,
    /// Normalised camera-to-world poses, one per view.
    pub c2w: Vec<Pose>,
    /// Intrinsics in pixels, one per view.
    pub intrinsics: Vec<Intrinsics>,
    /// Frame of the scene, one per view.
    pub frame_index: Vec<usize>,
}

impl ClipViews {
    /// Returns the number of views.
    pub fn num_views(&self) -> usize {
        self.c2w.len()
    }
}

/// One training or evaluation item: context and target views of one scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Clip {
    /// Key of the scene.
    pub key: String,
    /// Context views.
    pub context: ClipViews,
    /// Target views with their ground-truth images.
    pub target: ClipViews,
}
