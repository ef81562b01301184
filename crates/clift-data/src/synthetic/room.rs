//! A room: box-shaped walls, boxes and balls on the floor, a lamp and a camera path.

use std::f32::consts::TAU;

use clift_core::{uniform_01, uniform_below, uniform_between};
use glam::{DVec3, Vec3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use crate::synthetic::camera_path::{CLEARANCE, CameraPath};
use crate::synthetic::config::SyntheticConfig;
use crate::synthetic::tracing::surface::{Pattern, Surface, Wave, linear_color};

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
        let [small, large] = config.room_half_size;
        let mut half = || small + (large - small) * uniform_01(rng);
        let (wide, deep) = (half(), half());
        let tall = small * (0.6 + 0.15 * uniform_01(rng));
        let half_size = DVec3::new(wide, tall, deep);
        let path = CameraPath::sample(rng, half_size, config.path_length, config.looks);
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
        let [fewest, most] = if is_plain { [0, 0] } else { config.num_objects };
        for _ in 0..uniform_between(rng, fewest, most) {
            let object = (0..MAX_PLACEMENTS).find_map(|attempt| room.try_object(rng, config, attempt));
            room.objects.extend(object);
        }
        room
    }

    /// Samples an object on the floor. Returns `None` if the object touches the path, a wall or another object.
    fn try_object(&self, rng: &mut impl Rng, config: &SyntheticConfig, attempt: u32) -> Option<Object> {
        let scale = config.room_half_size[0] * 0.96_f64.powi(attempt as i32);
        let mut size = |low: f64, high: f64| (scale * (low + (high - low) * uniform_01(rng))) as f32;
        let (radius, edges) = (size(0.13, 0.26), [size(0.1, 0.2), size(0.1, 0.34), size(0.1, 0.2)]);
        let (sin, cos) = (uniform_01(rng) as f32 * TAU).sin_cos();
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
        let [nearest, farthest] = self.path.radius_bounds().map(|radius| radius as f32);
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
    let turn = uniform_01(rng) * std::f64::consts::TAU;
    let shift = 0.12 + 0.3 * uniform_01(rng);
    let darker = value * (0.25 + 0.15 * uniform_01(rng));
    let rate = TAU * (frequency * (0.7 + 0.6 * uniform_01(rng))) as f32;
    let phase = uniform_01(rng) as f32 * TAU;
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::config::LookDirection;
    use clift_core::step_rng;

    /// Returns the distance from a point to the surface of an object, 0 inside.
    fn distance(object: &Object, point: Vec3) -> f32 {
        let from_center = point - object.center;
        match object.shape {
            Shape::Ball { radius } => (from_center.length() - radius).max(0.0),
            Shape::Block { half_size, turn } => (turned(from_center, turn).abs() - half_size).max(Vec3::ZERO).length(),
        }
    }

    fn rooms(config: &SyntheticConfig) -> Vec<Room> {
        (0..200).map(|index| Room::sample(&mut step_rng(3, index, "test"), config)).collect()
    }

    #[test]
    fn camera_stays_clear_of_walls_and_objects() {
        // The room is in f32, the path in f64: 1e-5 covers the difference.
        let least = CLEARANCE as f32 - 1e-5;
        let crowded = SyntheticConfig {
            room_half_size: [1.0, 3.0],
            num_objects: [20, 30],
            path_length: 20.0,
            ..Default::default()
        };
        let turning = SyntheticConfig { looks: LookDirection::Out, ..crowded.clone() };
        for config in [SyntheticConfig::default(), crowded, turning] {
            for room in rooms(&config) {
                for time in 0..=500 {
                    let position = room.path.position(f64::from(time) / 500.0).as_vec3();
                    let to_walls = room.half_size - position.abs();
                    assert!(to_walls.min_element() > least, "{position} in {}", room.half_size);
                    for object in &room.objects {
                        let apart = distance(object, position);
                        assert!(apart > least, "{apart} from {object:?}");
                    }
                }
            }
        }
    }

    #[test]
    fn objects_stand_apart_on_the_floor() {
        for room in rooms(&SyntheticConfig::default()) {
            for (i, object) in room.objects.iter().enumerate() {
                let height = match object.shape {
                    Shape::Ball { radius } => radius,
                    Shape::Block { half_size, .. } => half_size.y,
                };
                assert!((object.center.y + height - room.half_size.y).abs() < 1e-5);
                assert!([0, 2].iter().all(|&axis| object.center[axis].abs() + object.reach() < room.half_size[axis]));
                for other in &room.objects[i + 1..] {
                    let Vec3 { x, z, .. } = object.center - other.center;
                    assert!(x.hypot(z) > object.reach() + other.reach());
                }
            }
        }
    }

    #[test]
    fn camera_that_looks_out_faces_away_from_the_middle() {
        for looks in [LookDirection::In, LookDirection::Out] {
            for room in rooms(&SyntheticConfig { looks, ..Default::default() }) {
                for time in [0.0, 0.3, 1.0] {
                    let camera = room.path.camera(time, 75.0, 1.0).c2w;
                    let (forward, centre) = (camera.rotation.z_axis, camera.translation);
                    let away = forward.x * centre.x + forward.z * centre.z;
                    assert_eq!(away > 0.0, looks == LookDirection::Out, "{forward} at {centre}");
                }
            }
        }
    }

    #[test]
    fn plain_share_sets_the_number_of_empty_rooms() {
        let plain = |plain_share| {
            let config = SyntheticConfig { plain_share, ..Default::default() };
            rooms(&config).iter().filter(|room| room.objects.is_empty()).count()
        };
        assert_eq!((plain(0.0), plain(1.0)), (0, 200));
        // Four standard deviations of 200 samples: 28.
        assert!((72..=128).contains(&plain(0.5)), "{}", plain(0.5));
    }

    #[test]
    fn default_rooms_have_the_configured_number_of_objects() {
        let counts: Vec<usize> = rooms(&SyntheticConfig::default()).iter().map(|room| room.objects.len()).collect();
        assert!(counts.iter().all(|count| (3..=5).contains(count)), "{counts:?}");
        assert!([3, 4, 5].iter().all(|count| counts.contains(count)));
    }
}
