//! Light of a scene: a key light with shadow, light of the sky and of the surroundings, fill lights, highlights, haze.

use glam::{Vec3, Vec4};

use crate::synthetic::real::noise::octaves;
use crate::synthetic::real::solid::Rays;
use crate::synthetic::real::world::{SKY, World};

/// Distance between a surface and the rays that start there.
const OFFSET: f32 = 2e-3;
/// Smallest weight of a mirrored ray.
const LEAST_MIRROR: f32 = 0.03;

/// Lamp or sun.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Key {
    Sun {
        towards: Vec3,
    },
    /// The light halves at `reach`.
    Lamp {
        at: Vec3,
        reach: f32,
    },
}

/// A window or another large light without shadow. The light halves at `reach`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Fill {
    pub at: Vec3,
    pub reach: f32,
    pub color: Vec3,
}

#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Light {
    pub key: Key,
    pub key_color: Vec3,
    /// Angular size of the key light.
    pub softness: f32,
    /// Light from above and from below.
    pub ambient: [Vec3; 2],
    /// Distance up to which surfaces hide the ambient light.
    pub reach: f32,
    pub fills: Vec<Fill>,
    /// Sky at the horizon and above.
    pub sky: [Vec3; 2],
    /// Strength of clouds.
    pub clouds: f32,
    pub seed: u32,
    /// Distance at which half of the light is haze.
    pub haze: f32,
}

/// A point where a ray ends.
pub(crate) struct End {
    pub origin: Vec3,
    pub direction: Vec3,
    pub distance: f32,
    /// Number of the solid.
    pub number: usize,
    pub normal: Vec3,
}

impl Light {
    /// Returns the linear light that comes along a ray of the angular width `pixel`.
    pub fn seen(&self, world: &World, end: &End, pixel: f32) -> Vec3 {
        let &End { origin, direction, distance, number, normal } = end;
        if number == SKY {
            return self.of_sky(direction, pixel);
        }
        let point = origin + direction * distance;
        let facing = -direction.dot(normal);
        let width = distance * pixel / facing.max(0.15).sqrt();
        let (surface, color) = world.color(number, point, normal, width);

        let start = point + normal * (OFFSET + 1e-4 * distance);
        let (towards, far, strength) = self.towards_key(start);
        let lit = normal.dot(towards).max(0.0) * strength;
        let [one, two, three] = around(normal);
        let rays = Rays::new(start, [towards, one, two, three]);
        let ends = Vec4::new(if lit > 0.0 { far } else { 0.0 }, self.reach, self.reach, self.reach);
        let shares = world.light_along(&rays, ends, self.softness);
        let open = 0.2 + 0.8 / 3.0 * (shares.y + shares.z + shares.w);
        let key = self.key_color * shares.x;

        let mut light = color * (self.soft(start, normal) * open + key * lit + Vec3::splat(surface.glow));
        if surface.gloss > 0.0 {
            let mirrored = direction.reflect(normal);
            let glint = mirrored.dot(towards).max(0.0).powi(4 + (60.0 * surface.gloss) as i32);
            light += key * (strength * surface.gloss * glint);
            let grazing = (1.0 - facing).clamp(0.0, 1.0);
            let weight = surface.gloss * (0.05 + 0.6 * grazing.powi(4));
            if weight > LEAST_MIRROR {
                light = light.lerp(self.mirrored(world, start, mirrored, pixel), weight);
            }
        }
        light.lerp(self.sky[0], distance / (distance + self.haze))
    }

    /// Returns the light of the sky, the surroundings and the fill lights on a surface that nothing hides.
    fn soft(&self, point: Vec3, normal: Vec3) -> Vec3 {
        let mut light = self.ambient[1].lerp(self.ambient[0], 0.5 - 0.5 * normal.y);
        for fill in &self.fills {
            let way = fill.at - point;
            let squared = way.length_squared().max(0.04);
            let facing = (0.15 + normal.dot(way) / squared.sqrt()).max(0.0);
            light += fill.color * (facing / (1.0 + squared / (fill.reach * fill.reach)));
        }
        light
    }

    /// Returns direction, distance and strength of the key light.
    fn towards_key(&self, point: Vec3) -> (Vec3, f32, f32) {
        match self.key {
            Key::Sun { towards } => (towards, 1e4, 1.0),
            Key::Lamp { at, reach } => {
                let way = at - point;
                let distance = way.length().max(1e-3);
                // The lamp itself casts no shadow.
                (way / distance, (distance - 0.25).max(0.0), 1.0 / (1.0 + (distance / reach).powi(2)))
            }
        }
    }

    /// Returns what a polished surface mirrors, in soft light only.
    fn mirrored(&self, world: &World, origin: Vec3, direction: Vec3, pixel: f32) -> Vec3 {
        let (distance, number) = world.first(origin, direction);
        if number == SKY {
            return self.of_sky(direction, pixel);
        }
        let point = origin + direction * distance;
        let normal = world.normal(number, point);
        let (surface, color) = world.color(number, point, normal, (distance + 2.0) * pixel * 1.5);
        color * (self.soft(point, normal) * 0.8 + self.key_color * 0.15 + Vec3::splat(surface.glow))
    }

    pub fn of_sky(&self, direction: Vec3, pixel: f32) -> Vec3 {
        let up = (-direction.y).max(0.0);
        let mut sky = self.sky[0].lerp(self.sky[1], up.sqrt());
        if self.clouds > 0.0 && up > 0.02 {
            let [x, z] = [direction.x, direction.z].map(|side| side / (up + 0.15));
            let cloud = octaves(x * 1.5, z * 1.5, self.seed, 0.6, pixel * 1.5 / (up + 0.15));
            sky = sky.lerp(Vec3::splat(sky.max_element() * 1.15), (self.clouds * (0.3 + cloud)).clamp(0.0, 1.0));
        }
        sky
    }
}

/// Returns three directions around a normal, 120 degrees apart and 45 degrees off.
fn around(normal: Vec3) -> [Vec3; 3] {
    let [one, other] = [normal.any_orthonormal_vector(), normal.cross(normal.any_orthonormal_vector())];
    [(1.0, 0.0), (-0.5, 0.866), (-0.5, -0.866)].map(|(a, b)| (normal + one * a + other * b) * 0.7071)
}
