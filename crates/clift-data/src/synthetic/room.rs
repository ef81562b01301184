//! A room: box-shaped walls, boxes and balls on the floor, a lamp, and the camera's path: an arc around the middle of
//! the room that faces a slowly moving point.

use std::f64::consts::TAU;

use clift_core::{Camera, IntrinsicsNorm, Pose, uniform_01, uniform_below, uniform_between};
use glam::{DMat3, DVec3, Vec3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use crate::synthetic::config::SyntheticConfig;
use crate::synthetic::tracing::surface::{Pattern, Surface, Wave, linear_color};

/// Smallest and largest distance from the middle of a room to its walls.
const HALF_SIZE: [f64; 2] = [1.5, 2.0];
const NUM_OBJECTS: [usize; 2] = [3, 5];
/// Attempts to place an object, each 4 % smaller, before the room counts as full.
const MAX_PLACEMENTS: u32 = 60;

/// The turn of a block is about the vertical, as (cosine, sine); half sizes are half edge lengths.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Shape {
    Ball { radius: f32 },
    Block { half_size: Vec3, turn: [f32; 2] },
}

#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Object {
    pub shape: Shape,
    pub center: Vec3,
    pub surface: Surface,
}

impl Object {
    /// Returns the radius of the upright cylinder around the object.
    pub fn reach(&self) -> f32 {
        match self.shape {
            Shape::Ball { radius } => radius,
            Shape::Block { half_size, .. } => half_size.x.hypot(half_size.z),
        }
    }
}

/// A synthetic scene: a room around the origin with x right, y down, z forward.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Room {
    pub half_size: Vec3,
    /// Surfaces at -x, +x, -y (ceiling), +y (floor), -z, +z.
    pub walls: [Surface; 6],
    pub objects: Vec<Object>,
    pub lamp: Vec3,
    pub path: CameraPath,
}

impl Room {
    /// Samples a room. Expects a valid `config`.
    pub fn sample(rng: &mut ChaCha8Rng, config: &SyntheticConfig) -> Self {
        let [small, large] = HALF_SIZE;
        let mut half = || small + (large - small) * uniform_01(rng);
        let (wide, deep) = (half(), half());
        let tall = small * (0.6 + 0.15 * uniform_01(rng));
        let half_size = DVec3::new(wide, tall, deep);
        let path = CameraPath::sample(rng, half_size, config.path_length);
        let lamp = DVec3::new(wide * swing(rng, 0.35), -tall + 0.12, deep * swing(rng, 0.35));
        // Without plain rooms no random number is sampled: rooms equal those from before this option.
        let is_plain = config.plain_share > 0.0 && uniform_01(rng) < config.plain_share;
        let hue = uniform_01(rng);
        let frequency = if is_plain { 0.0 } else { config.texture_frequency };
        let walls = [0, 1, 2, 3, 4, 5].map(|side| {
            let (hue, saturation, value, frequency) = match side {
                2 => (hue, 0.1, 0.9, 0.5 * frequency),
                3 => (0.05 + 0.1 * uniform_01(rng), 0.35, 0.75, frequency),
                // The hues of the four walls are a quarter turn apart.
                _ => {
                    let quarter = [0.0, 0.5, 0.0, 0.0, 0.25, 0.75][side] + swing(rng, 0.05);
                    let value = if side < 2 { 0.95 } else { 0.7 };
                    (hue + quarter, 0.5 + 0.3 * uniform_01(rng), value, frequency)
                }
            };
            let gloss = if side == 3 { 0.35 } else { 0.0 };
            Surface { gloss, ..sample_surface(rng, hue, saturation, value, frequency) }
        });
        let mut room = Self { half_size: half_size.as_vec3(), walls, objects: Vec::new(), lamp: lamp.as_vec3(), path };
        let [fewest, most] = if is_plain { [0, 0] } else { NUM_OBJECTS };
        for _ in 0..uniform_between(rng, fewest, most) {
            let object = (0..MAX_PLACEMENTS).find_map(|attempt| room.try_object(rng, config, attempt));
            room.objects.extend(object);
        }
        room
    }

    /// Samples an object on the floor. Returns `None` if the object touches the path, a wall or another object.
    fn try_object(&self, rng: &mut impl Rng, config: &SyntheticConfig, attempt: u32) -> Option<Object> {
        let scale = HALF_SIZE[0] * 0.96_f64.powi(attempt as i32);
        let mut size = |low: f64, high: f64| (scale * (low + (high - low) * uniform_01(rng))) as f32;
        let (radius, edges) = (size(0.13, 0.26), [size(0.1, 0.2), size(0.1, 0.34), size(0.1, 0.2)]);
        let (sin, cos) = (uniform_01(rng) as f32 * std::f32::consts::TAU).sin_cos();
        let is_ball = uniform_01(rng) < 0.5;
        let (shape, height) = if is_ball {
            (Shape::Ball { radius }, radius)
        } else {
            (Shape::Block { half_size: edges.into(), turn: [cos, sin] }, edges[1])
        };
        let Vec3 { x: wide, y: floor, z: deep } = self.half_size;
        let center = Vec3::new(wide * swing(rng, 1.0) as f32, floor - height, deep * swing(rng, 1.0) as f32);
        let hue = uniform_01(rng);
        let surface = sample_surface(rng, hue, 0.75, 0.95, 2.0 * config.texture_frequency);
        let object = Object { shape, center, surface: Surface { gloss: uniform_01(rng) as f32, ..surface } };
        self.has_room_for(&object).then_some(object)
    }

    fn has_room_for(&self, object: &Object) -> bool {
        let (Vec3 { x, z, .. }, reach) = (object.center, object.reach());
        let from_axis = x.hypot(z);
        let swings = [1.0 - RADIUS_SWING, 1.0 + RADIUS_SWING];
        let [nearest, farthest] = swings.map(|swing| (self.path.radius * swing) as f32);
        let clearance = CLEARANCE as f32;
        let off_path = from_axis + reach + clearance < nearest || from_axis - reach - clearance > farthest;
        let inside = x.abs() + reach < self.half_size.x && z.abs() + reach < self.half_size.z;
        let apart = self
            .objects
            .iter()
            .all(|other| (x - other.center.x).hypot(z - other.center.z) > reach + other.reach() + 0.02);
        off_path && inside && apart
    }
}

/// Samples a matt surface around `hue` (in turns), with about `frequency` cycles per unit of length. `saturation` and `value`
/// describe the brighter colour.
fn sample_surface(rng: &mut impl Rng, hue: f64, saturation: f64, value: f64, frequency: f64) -> Surface {
    let wave = [Wave::Gradient, Wave::Stripes, Wave::Checkers, Wave::Ripples][uniform_below(rng, 4)];
    let turn = uniform_01(rng) * TAU;
    let shift = 0.12 + 0.3 * uniform_01(rng);
    let darker = value * (0.25 + 0.15 * uniform_01(rng));
    let rate = std::f32::consts::TAU * (frequency * (0.7 + 0.6 * uniform_01(rng))) as f32;
    let phase = uniform_01(rng) as f32 * std::f32::consts::TAU;
    let mut surface = Surface::plain(linear_color(hue, saturation, value));
    surface.colors[1] = linear_color(hue + shift, saturation, darker);
    Surface { pattern: Pattern::Waves { wave, phase }, turn: [turn.cos() as f32, turn.sin() as f32], rate, ..surface }
}

/// Rotates a vector about the vertical axis by (cosine, sine).
pub(crate) fn turned(v: Vec3, [cos, sin]: [f32; 2]) -> Vec3 {
    Vec3::new(cos * v.x + sin * v.z, v.y, cos * v.z - sin * v.x)
}

/// Samples uniformly from `[-size, size)`.
fn swing(rng: &mut impl Rng, size: f64) -> f64 {
    size * (2.0 * uniform_01(rng) - 1.0)
}

/// Smallest distance between the camera and any surface, in the scene's units of length.
pub(crate) const CLEARANCE: f64 = 0.25;

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
}

/// Amplitude of the radius over its mean.
const RADIUS_SWING: f64 = 0.06;

impl CameraPath {
    /// Samples a path of about `length` in a room of `half_size` (y is down).
    pub fn sample(rng: &mut impl Rng, half_size: DVec3, length: f64) -> Self {
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
            radius,
            start: uniform_01(rng) * TAU,
            sweep: side * length / radius,
            height,
            target: [target, drift],
            phase: uniform_01(rng) * TAU,
        }
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
        let forward = unit_vector(target + swing * drift - position);
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
