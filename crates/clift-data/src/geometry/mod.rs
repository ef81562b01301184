//! Cameras and poses in f64, OpenCV axes. Read `pose` and `camera` first.
//!
//! - `pose`: rigid poses on glam, conventions
//! - `camera`: intrinsics and cameras
//! - `lens`: OpenCV and COLMAP lens distortion
//! - `normalization`: normalised frame of a scene
//! - `overlap`: view overlap of two cameras
//! - `camera_path`: interpolated paths and orbits
//! - `pose_file`: poses to render, from a file
//! - `path_spread`: context frames spread along a path

pub(crate) mod camera;
pub(crate) mod camera_path;
pub(crate) mod lens;
pub(crate) mod normalization;
pub(crate) mod overlap;
pub(crate) mod path_spread;
pub(crate) mod pose;
pub(crate) mod pose_file;
