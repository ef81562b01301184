//! The camera's path: an arc around the middle of the room that faces a slowly moving point.

use std::f64::consts::TAU;

use clift_core::{Camera, IntrinsicsNorm, Pose, uniform_01};
use glam::{DMat3, DVec3};
use rand::Rng;

use crate::synthetic::config::LookDirection;

/// Smallest distance between the camera and any surface, in the scene's units of length.
pub(crate) const CLEARANCE: f64 = 0.25;

/// A smooth camera path. `time` runs from 0 to 1.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct CameraPath {
    radius: f64,
    start: f64,
    sweep: f64,
    /// Mean height of the camera relative to the room's middle, downwards, and the amplitude of its swing.
    height: [f64; 2],
    /// Mean fixated point, and the amplitude of its swing.
    target: [DVec3; 2],
    phase: f64,
    looks: LookDirection,
}

/// Radius of the path of a camera that looks out, as a share of one that looks in.
const INNER_RADIUS: f64 = 0.25;
/// Amplitude of the radius over its mean.
const RADIUS_SWING: f64 = 0.06;

impl CameraPath {
    /// Samples a path of about `length` in a room of `half_size` (y is down).
    pub fn sample(rng: &mut impl Rng, half_size: DVec3, length: f64, looks: LookDirection) -> Self {
        let radius = (half_size.x.min(half_size.z) - CLEARANCE) * (0.86 + 0.08 * uniform_01(rng));
        let side = if uniform_01(rng) < 0.5 { -1.0 } else { 1.0 };
        let tall = half_size.y;
        let mut around = |size: f64| (2.0 * uniform_01(rng) - 1.0) * size;
        let height = [tall * (-0.15 + around(0.2)), around(0.15 * tall)];
        // At most 0.6 of the radius from the axis: the camera never reaches its fixated point.
        let target = DVec3::new(around(0.1 * radius), tall * (0.2 + around(0.15)), around(0.1 * radius));
        let (sin, cos) = around(0.5 * TAU).sin_cos();
        let pan = radius * (0.35 + around(0.1));
        let drift = DVec3::new(pan * cos, around(0.3 * tall), pan * sin);
        Self {
            radius: if looks == LookDirection::Out { INNER_RADIUS * radius } else { radius },
            looks,
            start: uniform_01(rng) * TAU,
            sweep: side * length / radius,
            height,
            target: [target, drift],
            phase: uniform_01(rng) * TAU,
        }
    }

    /// Returns the smallest and the largest horizontal distance of the camera from the room's vertical axis.
    pub fn radius_bounds(&self) -> [f64; 2] {
        [self.radius * (1.0 - RADIUS_SWING), self.radius * (1.0 + RADIUS_SWING)]
    }

    pub fn position(&self, time: f64) -> DVec3 {
        let (sin, cos) = (self.start + self.sweep * time).sin_cos();
        let radius = self.radius * (1.0 + RADIUS_SWING * (TAU * time + self.phase).sin());
        let height = self.height[0] + self.height[1] * (0.5 * TAU * time + self.phase).sin();
        DVec3::new(radius * cos, height, radius * sin)
    }

    /// Returns an upright camera with square pixels and a horizontal field of view of `fov_deg` degrees.
    pub fn camera(&self, time: f64, fov_deg: f64, aspect: f64) -> Camera<IntrinsicsNorm> {
        let position = self.position(time);
        let swing = (TAU * time + self.phase).cos();
        let [target, drift] = self.target;
        let inwards = target + swing * drift - position;
        let forward = match self.looks {
            LookDirection::In => inwards,
            // Away from the vertical axis, with the height of the direction inwards.
            LookDirection::Out => {
                let away = self.radius / INNER_RADIUS / position.x.hypot(position.z);
                DVec3::new(away * position.x, inwards.y, away * position.z)
            }
        };
        let forward = unit_vector(forward);
        let right = unit_vector(DVec3::Y.cross(forward));
        let fx = 0.5 / (0.5 * fov_deg.to_radians()).tan();
        Camera {
            intrinsics: IntrinsicsNorm { fx, fy: fx * aspect, cx: 0.5, cy: 0.5 },
            c2w: Pose { rotation: DMat3::from_cols(right, forward.cross(right), forward), translation: position },
        }
    }
}

/// Normalises a vector other than zero. [`DVec3::normalize`] multiplies by the reciprocal, which would change rooms.
fn unit_vector(v: DVec3) -> DVec3 {
    v / v.length()
}
