//! Images and cameras as tensors: the inputs of the encoder.
//!
//! - `upload`: copies images and cameras to a device
//! - `rays`: Plücker coordinates of every pixel
//! - `patch`: images to patch vectors and back
//! - `patch_grids`: images averaged over shifted grids of patches

pub(crate) mod patch;
pub(crate) mod patch_grids;
pub(crate) mod rays;
pub(crate) mod upload;
