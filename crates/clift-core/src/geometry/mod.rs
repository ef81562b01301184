//! Cameras and poses in f64, OpenCV axes. Read `pose` and `camera` first.
//!
//! - `pose`: rigid poses on glam, conventions
//! - `camera`: intrinsics and cameras
//! - `normalization`: normalised frame of a scene
//! - `camera_path`: interpolated paths and orbits
//! - `view_distance`: how far apart two views of a place are

pub(crate) mod camera;
pub(crate) mod camera_path;
pub(crate) mod normalization;
pub(crate) mod pose;
pub(crate) mod view_distance;
