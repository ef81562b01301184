//! Posed images on the host.

use crate::geometry::camera::Camera;

/// Posed views of one scene at the model's resolution, in the scene's normalised frame.
#[derive(Clone, Debug, PartialEq)]
pub struct ClipViews {
    /// Columns of every view.
    pub width: usize,
    /// Rows of every view.
    pub height: usize,
    /// `[num_views, height, width, 3]`, 8-bit RGB.
    pub images: Vec<u8>,
    /// Normalised cameras, one per view.
    pub cameras: Vec<Camera>,
    /// Frame of the scene, one per view.
    pub frame_index: Vec<usize>,
}

impl ClipViews {
    /// Returns the number of views.
    pub fn num_views(&self) -> usize {
        self.cameras.len()
    }
}
