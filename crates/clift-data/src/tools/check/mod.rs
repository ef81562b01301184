//! The checks of `clift data check`. Read `scene` first: it calls the others.
//!
//! - `result`: findings of one scene
//! - `cameras`: plausible intrinsics and poses
//! - `images`: readable, equal-sized, distinct images
//! - `epipolar`: poses against matched corners
//! - `drawing`: two frames with epipolar lines
//! - `scene`: check one scene

pub(crate) mod cameras;
pub(crate) mod drawing;
pub(crate) mod epipolar;
pub(crate) mod images;
pub(crate) mod result;
pub(crate) mod scene;
