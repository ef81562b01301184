//! View indices and clips.

use clift_core::ClipViews;
use serde::{Deserialize, Serialize};

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

/// One training or evaluation item: context and target views of one scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Clip {
    /// Key of the scene.
    pub key: String,
    /// Context views.
    pub context: ClipViews,
    /// Target views with their ground-truth images.
    pub target: ClipViews,
    /// Weights of the target pixels in loss and metrics, `[num_views, height, width]`: 255 counts, 0 is masked or
    /// transparent. `None` where every pixel counts.
    pub target_weights: Option<Vec<u8>>,
}
