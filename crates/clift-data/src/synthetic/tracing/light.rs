//! Light of a scene: a key light with shadow, light of the sky and of the surroundings, fill lights, highlights, haze.

use glam::{Vec3, Vec4};

use crate::synthetic::tracing::noise::octaves;
use crate::synthetic::tracing::solid::Rays;
use crate::synthetic::tracing::world::{SKY, World};

/// Distance between a surface and the rays that start there.
const OFFSET: f32 = 2e-3;
const LEAST_MIRROR: f32 = 0.03;

#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Key {
    /// The light is equal everywhere.
    Sun { towards: Vec3 },
    /// The light halves at `reach`.
    Lamp { at: Vec3, reach: f32 },
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
    pub clouds: f32,
    pub seed: u32,
    /// Distance at which half of the light is haze.
    pub haze: f32,
}

#[derive(Clone, Copy)]
pub(crate) struct End {
    pub origin: Vec3,
    pub direction: Vec3,
    pub distance: f32,
    pub number: usize,
    pub normal: Vec3,
}

impl End {
    /// Returns a point slightly above the surface, from which rays start.
    fn start(&self) -> Vec3 {
        self.origin + self.direction * self.distance + self.normal * (OFFSET + 1e-4 * self.distance)
    }
}

impl Light {
    /// Returns the linear light along up to four rays that end on one surface, `None` for no ray. `pixel` is the angle
    /// between neighbouring pixels. The ambient light of all is that of the first.
    pub fn seen(&self, world: &World, ends: [Option<End>; 4], pixel: f32) -> [Vec3; 4] {
        let Some(first) = ends.iter().flatten().next() else { return [Vec3::ZERO; 4] };
        if first.number == SKY {
            return ends.map(|end| end.map_or(Vec3::ZERO, |end| self.of_sky(end.direction, pixel)));
        }
        let start = first.start();
        let around = Rays::new([start; 4], around(first.normal));
        let free = world.free_share(&around, self.reach);
        let open = 0.12 + 0.22 * free.element_sum();

        let starts = ends.map(|end| end.map_or(start, |end| end.start()));
        let keys = [0, 1, 2, 3].map(|lane| match &ends[lane] {
            Some(end) => self.towards_key(starts[lane], end.normal),
            None => (first.normal, -1.0, 0.0),
        });
        let to_key = Rays::new(starts, keys.map(|(towards, ..)| towards));
        let shares = world.lamp_share(&to_key, Vec4::from_array(keys.map(|(_, far, _)| far)), self.softness);

        [0, 1, 2, 3].map(|lane| {
            let Some(end) = &ends[lane] else { return Vec3::ZERO };
            let (towards, _, strength) = keys[lane];
            self.reflected(world, end, starts[lane], pixel, open, towards, strength * shares[lane])
        })
    }

    /// Returns the light from the end of a ray. `open` is the share of the ambient light there, `strength` that of the key
    /// light.
    #[expect(clippy::too_many_arguments, reason = "the parts of the light at one point")]
    fn reflected(
        &self,
        world: &World,
        end: &End,
        start: Vec3,
        pixel: f32,
        open: f32,
        towards: Vec3,
        strength: f32,
    ) -> Vec3 {
        let &End { direction, distance, number, normal, .. } = end;
        let facing = -direction.dot(normal);
        let width = distance * pixel / facing.max(0.15).sqrt();
        let (surface, color) = world.color(number, start, normal, width);
        let key = self.key_color * strength;
        let lit = normal.dot(towards).max(0.0);
        let mut light = color * (self.soft(start, normal) * open + key * lit + Vec3::splat(surface.glow));
        if surface.gloss > 0.0 {
            let mirrored = direction.reflect(normal);
            let glint = mirrored.dot(towards).max(0.0).powi(4 + (60.0 * surface.gloss) as i32);
            light += key * (surface.gloss * glint);
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

    /// Returns direction, distance and strength of the key light; the distance is negative where it shines from behind.
    fn towards_key(&self, point: Vec3, normal: Vec3) -> (Vec3, f32, f32) {
        let (towards, distance, strength) = match self.key {
            Key::Sun { towards } => (towards, 1e4, 1.0),
            Key::Lamp { at, reach } => {
                let way = at - point;
                let distance = way.length().max(1e-3);
                // The lamp itself casts no shadow.
                (way / distance, (distance - 0.25).max(0.0), 1.0 / (1.0 + (distance / reach).powi(2)))
            }
        };
        if normal.dot(towards) > 0.0 { (towards, distance, strength) } else { (towards, -1.0, 0.0) }
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

/// Returns four directions around a normal, 90 degrees apart and 50 degrees off.
fn around(normal: Vec3) -> [Vec3; 4] {
    let one = normal.any_orthonormal_vector();
    let other = normal.cross(one);
    [one, other, -one, -other].map(|side| normal * 0.64 + side * 0.77)
}
