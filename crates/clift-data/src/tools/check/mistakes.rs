//! The usual mistakes in the cameras of a whole scene: another convention, another focal length, a turn.

use std::fmt;

use glam::{DMat3, DVec3};

use crate::tools::features::pixel_camera::PixelCamera;

/// Factors of the focal lengths.
const FOCAL_SCALES: [f64; 4] = [0.8, 0.9, 1.1, 1.25];
/// Angles of a turn of every camera, in degrees.
const TURNS_DEG: [f64; 2] = [2.0, 4.0];

/// A change of every camera that undoes a usual mistake. Prints what the files hold.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Mistake {
    /// OpenGL's axes (y up, z backward) for OpenCV's, or the reverse.
    Axes,
    /// `w2c` for `c2w`, or the reverse.
    Inverse,
    /// Both: `w2c` with OpenGL's axes.
    InverseAndAxes,
    /// Focal lengths that fit better after this factor.
    Focal(f64),
    /// Cameras that fit better after this turn about an axis of their own, in degrees.
    Turn([i8; 3], f64),
}

impl Mistake {
    /// Returns all mistakes that are tried.
    pub fn all() -> impl Iterator<Item = Self> {
        let axes =
            (0..27).map(|index| [index / 9 - 1, index / 3 % 3 - 1, index % 3 - 1]).filter(|axis| *axis != [0; 3]);
        let turns = axes.flat_map(|axis| TURNS_DEG.map(|angle_deg| Self::Turn(axis, angle_deg)));
        [Self::Axes, Self::Inverse, Self::InverseAndAxes].into_iter().chain(FOCAL_SCALES.map(Self::Focal)).chain(turns)
    }

    /// Returns the camera without the mistake.
    pub fn corrected(self, camera: &PixelCamera) -> PixelCamera {
        let mut camera = *camera;
        let opposite_axes = DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
        match self {
            Self::Axes => camera.c2w.rotation *= opposite_axes,
            Self::Inverse => camera.c2w = camera.c2w.inverse(),
            Self::InverseAndAxes => {
                camera.c2w = camera.c2w.inverse();
                camera.c2w.rotation *= opposite_axes;
            }
            Self::Focal(scale) => camera = camera.with_focal_scale(scale),
            Self::Turn(axis, angle_deg) => {
                let axis = DVec3::from_array(axis.map(f64::from)).normalize();
                camera.c2w.rotation *= DMat3::from_axis_angle(axis, angle_deg.to_radians());
            }
        }
        camera
    }
}

impl fmt::Display for Mistake {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Axes => {
                write!(f, "the y and z axes of every camera reversed (OpenGL's axes for OpenCV's, or the reverse)")
            }
            Self::Inverse => write!(f, "every pose inverted (world-to-camera for camera-to-world, or the reverse)"),
            Self::InverseAndAxes => {
                write!(f, "every pose inverted, then its y and z axes reversed (OpenGL's view matrices)")
            }
            Self::Focal(scale) => write!(f, "focal lengths times {scale}"),
            Self::Turn([x, y, z], angle_deg) => {
                write!(f, "every camera turned by {angle_deg} degrees about its own axis ({x}, {y}, {z})")
            }
        }
    }
}
