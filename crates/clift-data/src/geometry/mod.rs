//! Camera geometry of data sets, beyond the cameras of `clift-core`.
//!
//! - `lens`: OpenCV and COLMAP lens distortion
//! - `overlap`: view overlap of two cameras
//! - `pose_file`: poses to render, from a file
//! - `path_spread`: context frames spread along a path

pub(crate) mod lens;
pub(crate) mod overlap;
pub(crate) mod path_spread;
pub(crate) mod pose_file;
