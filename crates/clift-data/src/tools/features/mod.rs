//! Corners, matches and epipolar geometry. `image_features` joins the steps; the files are in the order of the steps.
//!
//! - `corners`: gray images and their Shi-Tomasi corners
//! - `descriptor`: gradient histograms, mutual nearest ones
//! - `epipolar`: cameras and correspondences of corners, epipolar lines, RANSAC
//! - `image_features`: corners of an image, matched

pub(crate) mod corners;
pub(crate) mod descriptor;
pub(crate) mod epipolar;
pub(crate) mod image_features;
