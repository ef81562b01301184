//! Where the camera goes: an arc around the middle of the room, looking at a slowly moving point inside.

use std::f64::consts::TAU;

use rand::Rng;

use crate::camera::{Camera, IntrinsicsNorm, Pose};
use crate::order::unit;

use super::config::Looks;

/// Least distance, in the scene's units of length, between the camera and any surface.
pub(super) const CLEARANCE: f64 = 0.25;

/// A smooth camera path; `time` runs from 0 to 1.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct CameraPath {
    radius: f64,
    start: f64,
    sweep: f64,
    /// Height of the camera relative to the room's middle, downwards, and how far it swings.
    height: [f64; 2],
    /// The looked-at point and how far it swings.
    target: [[f64; 3]; 2],
    phase: f64,
    looks: Looks,
}

/// Radius of the path of a camera that looks out, as a share of one that looks in.
const INNER_RADIUS: f64 = 0.25;

/// How far the radius swings to either side, as a share of it.
const RADIUS_SWING: f64 = 0.06;

impl CameraPath {
    /// Draws a path about `length` long in a room with these `half_size`s (y is down).
    pub fn draw(rng: &mut impl Rng, half_size: [f64; 3], length: f64, looks: Looks) -> Self {
        let widest = half_size[0].min(half_size[2]) - CLEARANCE;
        let radius = widest * (0.86 + 0.08 * unit(rng));
        let side = if unit(rng) < 0.5 { -1.0 } else { 1.0 };
        let tall = half_size[1];
        let mut around = |size: f64| (2.0 * unit(rng) - 1.0) * size;
        let height = [tall * (-0.15 + around(0.2)), around(0.15 * tall)];
        // At most 0.6 of the radius from the axis, so that the camera never stands where it looks.
        let target = [around(0.1 * radius), tall * (0.2 + around(0.15)), around(0.1 * radius)];
        let (sin, cos) = around(0.5 * TAU).sin_cos();
        let pan = radius * (0.35 + around(0.1));
        let drift = [pan * cos, around(0.3 * tall), pan * sin];
        Self {
            radius: if looks == Looks::Out { INNER_RADIUS * radius } else { radius },
            looks,
            start: unit(rng) * TAU,
            sweep: side * length / radius,
            height,
            target: [target, drift],
            phase: unit(rng) * TAU,
        }
    }

    /// Smallest and largest horizontal distance of the camera from the room's vertical axis.
    pub fn radius_bounds(&self) -> [f64; 2] {
        [self.radius * (1.0 - RADIUS_SWING), self.radius * (1.0 + RADIUS_SWING)]
    }

    /// Camera centre.
    pub fn position(&self, time: f64) -> [f64; 3] {
        let (sin, cos) = (self.start + self.sweep * time).sin_cos();
        let radius = self.radius * (1.0 + RADIUS_SWING * (TAU * time + self.phase).sin());
        let height = self.height[0] + self.height[1] * (0.5 * TAU * time + self.phase).sin();
        [radius * cos, height, radius * sin]
    }

    /// Camera with square pixels and a horizontal field of view of `fov_deg`, upright.
    pub fn camera(&self, time: f64, fov_deg: f64, aspect: f64) -> Camera {
        let position = self.position(time);
        let swing = (TAU * time + self.phase).cos();
        let [target, drift] = self.target;
        let forward = [0, 1, 2].map(|i| target[i] + swing * drift[i] - position[i]);
        // Out is away from the axis of the room, as far up or down as in would be.
        let forward = unit_vector(match self.looks {
            Looks::In => forward,
            Looks::Out => {
                let away = self.radius / INNER_RADIUS / position[0].hypot(position[2]);
                [away * position[0], forward[1], away * position[2]]
            }
        });
        let right = unit_vector(cross([0.0, 1.0, 0.0], forward));
        let down = cross(forward, right);
        let fx = 0.5 / (0.5 * fov_deg.to_radians()).tan();
        Camera {
            intrinsics_norm: IntrinsicsNorm { fx, fy: fx * aspect, cx: 0.5, cy: 0.5 },
            c2w: Pose { rotation: [0, 1, 2].map(|i| [right[i], down[i], forward[i]]), translation: position },
        }
    }
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// Expects a vector that is not zero: a camera never stands where it looks, nor looks straight down.
fn unit_vector(v: [f64; 3]) -> [f64; 3] {
    let length = (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt();
    v.map(|x| x / length)
}
