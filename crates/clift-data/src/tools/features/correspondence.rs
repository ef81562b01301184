//! Correspondences of corners.

/// Number of columns to which wider images are reduced. Distances are in pixels of this width.
pub const WIDTH: usize = 640;

/// Two corners that show the same point, in pixels of an image [`WIDTH`] columns wide.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Correspondence {
    /// Column and row in the first image.
    pub first: [f64; 2],
    /// Column and row in the second image.
    pub second: [f64; 2],
}
