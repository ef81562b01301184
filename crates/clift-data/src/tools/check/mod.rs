//! The checks of `clift data check`. Read `scene` first: it calls the others.
//!
//! - `result`: findings of one scene
//! - `cameras`: plausible intrinsics and poses
//! - `images`: readable, equal-sized, distinct images
//! - `matches`: corners matched between frames
//! - `frames`: each frame against the others
//! - `epipolar`: poses against matched corners, the usual mistakes in cameras
//! - `scene`: check one scene

pub(crate) mod cameras;
pub(crate) mod epipolar;
pub(crate) mod frames;
pub(crate) mod images;
pub(crate) mod matches;
pub(crate) mod result;
pub(crate) mod scene;
