//! Cameras in the pixels of matched corners.

use clift_core::{Camera, IntrinsicsNorm, Pose};
use glam::{DMat3, DVec3};

use crate::tools::features::epipolar::WIDTH;

/// A camera of an image [`WIDTH`] columns wide, whose height keeps the shape of the pixels.
#[derive(Clone, Copy)]
pub(crate) struct PixelCamera {
    intrinsics: DMat3,
    inverse_intrinsics: DMat3,
    pub c2w: Pose,
}

impl PixelCamera {
    /// Converts a camera of an image with these columns and rows.
    pub fn new(camera: &Camera<IntrinsicsNorm>, [columns, rows]: [usize; 2]) -> Self {
        let k = camera.intrinsics;
        let (width, height) = (WIDTH as f64, WIDTH as f64 * rows as f64 / columns as f64);
        let rows = [k.fx * width, 0.0, k.cx * width, 0.0, k.fy * height, k.cy * height, 0.0, 0.0, 1.0];
        Self::with_intrinsics(DMat3::from_rows_array(&rows), camera.c2w)
    }

    fn with_intrinsics(intrinsics: DMat3, c2w: Pose) -> Self {
        Self { intrinsics, inverse_intrinsics: intrinsics.inverse(), c2w }
    }

    /// Returns the camera with other focal lengths.
    pub fn with_focal_scale(&self, scale: f64) -> Self {
        let scaled = DMat3::from_diagonal(DVec3::new(scale, scale, 1.0));
        let centre = self.intrinsics.z_axis;
        let mut intrinsics = self.intrinsics * scaled;
        intrinsics.z_axis = centre;
        Self::with_intrinsics(intrinsics, self.c2w)
    }

    /// Returns the direction of a pixel in the world.
    pub fn ray(&self, [x, y]: [f64; 2]) -> DVec3 {
        self.c2w.rotation * (self.inverse_intrinsics * DVec3::new(x, y, 1.0))
    }

    /// Returns the homogeneous pixel of a point of the world.
    pub fn project(&self, point: DVec3) -> DVec3 {
        self.project_direction(point - self.c2w.translation)
    }

    /// Returns the homogeneous pixel of a direction of the world.
    pub fn project_direction(&self, direction: DVec3) -> DVec3 {
        self.intrinsics * (self.c2w.rotation.transpose() * direction)
    }

    /// Returns the fundamental matrix of two cameras: `second^T F first = 0` for a point seen at `first` and `second`.
    pub fn fundamental(first: &Self, second: &Self) -> DMat3 {
        let Pose { rotation, translation: t } = second.c2w.inverse().after(first.c2w);
        // E = [t]x R, column by column.
        let essential = DMat3::from_cols(t.cross(rotation.x_axis), t.cross(rotation.y_axis), t.cross(rotation.z_axis));
        second.inverse_intrinsics.transpose() * essential * first.inverse_intrinsics
    }
}
