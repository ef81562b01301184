//! Camera geometry of data sets, beyond the cameras of `clift-core`.
//!
//! - `lens`: lens distortion of OpenCV, nerfstudio and COLMAP, COLMAP's models by name
//! - `overlap`: view overlap of two cameras
//! - `pose_file`: poses to render, from a file
//! - `path_spread`: context frames spread along a path
//! - `scaled_rotation`: poses whose rotation has a uniform scale

pub(crate) mod lens;
pub(crate) mod overlap;
pub(crate) mod path_spread;
pub(crate) mod pose_file;
pub(crate) mod scaled_rotation;
