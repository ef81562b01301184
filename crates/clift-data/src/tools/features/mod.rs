//! Corners, matches and epipolar geometry. `image_features` joins the steps; the files are in the order of the steps.
//!
//! - `gray_image`: gray levels, blur, gradients
//! - `corners`: Shi-Tomasi corners
//! - `descriptor`: gradient histograms
//! - `matching`: mutual nearest descriptors
//! - `epipolar`: correspondences of corners, epipolar lines, RANSAC
//! - `pixel_camera`: cameras in the pixels of corners
//! - `image_features`: corners of an image, matched

pub(crate) mod corners;
pub(crate) mod descriptor;
pub(crate) mod epipolar;
pub(crate) mod gray_image;
pub(crate) mod image_features;
pub(crate) mod matching;
pub(crate) mod pixel_camera;
