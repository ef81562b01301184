//! The common ground of models and data: cameras and poses, images, atomic files, statistics, random streams.
//!
//! Camera axes are OpenCV's: +x right, +y down, +z forward. This crate does not depend on Burn.
//!
//! ```
//! use clift_core::{DVec3, Pose, PoseNormalization, PoseRotation, PoseScale};
//!
//! // Two cameras, 4 units apart in the world: in the normalized frame the mean camera is the origin.
//! let context = [-2.0, 2.0].map(|x| Pose { translation: DVec3::new(x, 0.0, 5.0), ..Pose::IDENTITY });
//! let frame = PoseNormalization::find("scene", &context, &[], PoseRotation::Quaternion, PoseScale::Context)?;
//! assert_eq!(frame.normalize(context[1]).translation, DVec3::X);
//! # Ok::<(), clift_core::CameraError>(())
//! ```

mod bad_config;
mod clip_views;
mod error;
mod files;
mod geometry;
mod random;
mod rgb_image;
mod statistics;
#[cfg(test)]
mod testing;
mod wording;

// Cameras and poses.
pub use error::CameraError;
pub use geometry::camera::{Camera, Intrinsics, IntrinsicsNorm, widest_fov_deg};
pub use geometry::camera_path::{focus_distance, interpolate_path, mean_intrinsics, orbit_path};
pub use geometry::normalization::{MAX_COORDINATE, PoseNormalization, PoseRotation, PoseScale, check_near};
pub use geometry::pose::Pose;
pub use geometry::view_distance::ViewDistance;
pub use glam::{DMat3, DVec3};

// Values of a configuration.
pub use bad_config::{BadConfig, check_config};

// Images.
pub use clip_views::ClipViews;
pub use rgb_image::RgbImage;

// Atomic files.
pub use files::atomic::{
    TEMPORARY, folder_of, make_folder, publish_file, publish_folder, remove_folder, remove_leftovers, replace_file,
};
pub use files::staged_dir::{StagedDir, is_empty_folder};

// Random streams.
pub use random::{
    derive_seed, item_rng, mix, sample_distinct, sample_from, step_rng, uniform_01, uniform_below, uniform_between,
};

// Statistics.
pub use statistics::{MinMedianMax, mean, median, p95, quartiles, standard_error};

// Messages.
pub use wording::{first_few, plural};
