//! Images and cameras as tensors.
//!
//! - `upload`: images and cameras onto a device
//! - `camera`: one pinhole camera on the host
//! - `rays`: Plücker ray of every pixel
//! - `patch`: images to patch vectors and back

pub(crate) mod camera;
pub(crate) mod patch;
pub(crate) mod rays;
pub(crate) mod upload;
