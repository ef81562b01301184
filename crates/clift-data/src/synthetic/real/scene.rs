//! A scene with the statistics of photos: an interior, a place outdoors, or a thing that the camera goes around.

use std::f32::consts::TAU;

use clift_core::{Camera, IntrinsicsNorm, RgbImage};
use glam::Vec3;
use rand_chacha::ChaCha8Rng;

use crate::synthetic::real::builder::{Builder, Place};
use crate::synthetic::real::dice::{Dice, color};
use crate::synthetic::real::path::{Area, Path};
use crate::synthetic::tracing::light::{End, Fill, Key, Light};
use crate::synthetic::tracing::render::{Exposure, render};
use crate::synthetic::tracing::world::{SKY, World};

pub(crate) const CLEARANCE: f32 = 0.1;
/// Number of rays along each side of the views that set the exposure.
const METER: usize = 6;

/// Solids, light and camera path of a scene. Lengths are about metres, y is down, the floor is at 0.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct RealScene {
    world: World,
    light: Light,
    exposure: Exposure,
    pub path: Path,
}

impl RealScene {
    /// Samples a scene; `is_spread` for frames that differ as photos of several people do.
    pub fn sample(rng: ChaCha8Rng, is_spread: bool) -> Self {
        let mut builder = Builder::new(Dice(rng));
        let (light, area, ground) = match builder.dice.count(0, 19) {
            0..=10 => interior(&mut builder),
            11..=14 => outdoors(&mut builder),
            _ => thing(&mut builder),
        };
        let Builder { mut dice, solids, surfaces, .. } = builder;
        let world = World::new(solids, surfaces, ground);
        let mut path = Path::sample(&mut dice, &world, &area);
        if is_spread {
            path.spread_out();
        }
        // Where no path was clear, or a thin thing stands between the places that were checked.
        let positions = path.positions();
        let is_clear = positions.iter().all(|&position| world.is_clear(position, CLEARANCE));
        let world = if is_clear { world } else { world.clear_away(&positions, CLEARANCE) };
        let exposure = expose(&mut dice, &world, &light, &path);
        Self { world, light, exposure, path }
    }

    pub fn render(&self, camera: &Camera<IntrinsicsNorm>, frame: usize, size: [usize; 2]) -> RgbImage {
        let exposure = Exposure { gain: self.exposure.gain * self.path.exposure(frame), ..self.exposure };
        render(&self.world, &self.light, &exposure, camera, size)
    }
}

fn interior(builder: &mut Builder) -> (Light, Area, (f32, usize)) {
    let (plan, windows) = builder.flat();
    let ground = if builder.dice.chance(0.5) { 0.3 } else { builder.dice.between(0.3, 6.0) };
    if !windows.is_empty() {
        let near = plan.half[0].hypot(plan.half[1]) + 9.0;
        builder.surroundings(ground, near, 12);
    }
    let surface = builder.ground_surface();
    let [wide, deep] = plan.half;
    let eye = builder.dice.between(1.1, 1.7);
    let area = Area {
        center: Vec3::new(0.0, -eye, 0.0),
        half: Vec3::new(0.85 * wide, 0.1, 0.85 * deep),
        thing: None,
        clearance: 0.22,
    };
    let dice = &mut builder.dice;
    let warm = color(0.1, dice.between(0.0, 0.35), 1.0);
    let day = windows.len() as f32 * dice.between(0.3, 1.0);
    let key = if day > 0.5 && dice.chance(0.4) {
        sun(dice)
    } else {
        let at = Vec3::new(dice.swing(0.6 * wide), 0.25 - plan.height, dice.swing(0.6 * deep));
        Key::Lamp { at, reach: dice.between(1.5, 4.0) }
    };
    let is_sun = matches!(key, Key::Sun { .. });
    let bounce = dice.between(0.12, 0.35);
    let light = Light {
        key,
        key_color: if is_sun {
            Vec3::new(1.0, 0.92, 0.8) * dice.between(2.0, 5.0)
        } else {
            warm * dice.between(0.6, 2.4)
        },
        softness: if is_sun { 0.02 } else { dice.between(0.1, 0.4) },
        ambient: [warm * bounce, warm * (bounce * dice.between(0.5, 1.0))],
        reach: dice.between(0.6, 1.5),
        fills: windows
            .iter()
            .take(4)
            .map(|&at| Fill {
                at,
                reach: dice.between(1.0, 2.5),
                color: Vec3::new(0.9, 0.97, 1.08) * dice.between(0.2, 0.9),
            })
            .collect(),
        ..outside(dice, 2.5)
    };
    (light, area, (ground, surface))
}

fn outdoors(builder: &mut Builder) -> (Light, Area, (f32, usize)) {
    let radius = builder.open_place();
    let count = builder.dice.count(14, 30);
    builder.surroundings(0.0, radius + 1.5, count);
    let surface = builder.ground_surface();
    let eye = builder.dice.between(1.2, 2.2);
    let half = Vec3::new(0.8 * radius, 0.3, 0.8 * radius);
    let area = Area { center: Vec3::new(0.0, -eye, 0.0), half, thing: None, clearance: 0.3 };
    (outside(&mut builder.dice, 1.0), area, (0.0, surface))
}

fn thing(builder: &mut Builder) -> (Light, Area, (f32, usize)) {
    let indoors = builder.dice.chance(0.55);
    let (mut light, mut area, ground) = if indoors { interior(builder) } else { outdoors(builder) };
    let size = if indoors { builder.dice.scale(0.12, 0.5) } else { builder.dice.scale(0.3, 2.0) };
    // Nothing else may stand in the way of the camera.
    let reach = 3.0 * size + 0.4;
    let is_near =
        |center: Vec3, half: Vec3| center.x.hypot(center.z) - half.x.min(half.z) < reach && half.max_element() < 1.6;
    builder.solids.retain(|solid| !is_near(solid.center, solid.half));
    let mut place = Place::turned(Vec3::ZERO, builder.dice.between(0.0, TAU));
    if indoors && builder.dice.chance(0.7) {
        let high = builder.dice.between(0.4, 0.9);
        let half = [size * builder.dice.between(1.2, 3.0), size * builder.dice.between(1.2, 2.0)];
        builder.table(&place, half, high);
        place = place.then(0.0, high, 0.0, 0.0);
    }
    if builder.dice.chance(0.5) {
        let count = builder.dice.count(4, 14);
        builder.pile(&place, size, count);
    } else {
        builder.monument(&place, size);
    }
    area.thing = Some((place.point(0.0, 0.8 * size, 0.0), size));
    area.clearance = 0.12;
    if indoors && builder.dice.chance(0.5) {
        light.fills.push(Fill { at: place.point(0.0, 2.0, 0.0), reach: 1.5, color: Vec3::splat(0.5) });
    }
    (light, area, ground)
}

fn sun(dice: &mut Dice) -> Key {
    let (angle, up) = (dice.between(0.0, TAU), dice.between(0.25, 1.3));
    Key::Sun { towards: Vec3::new(angle.sin(), -up, angle.cos()).normalize() }
}

/// Samples daylight; `bright` scales what is seen of the sky.
fn outside(dice: &mut Dice, bright: f32) -> Light {
    let clear = dice.between(0.0, 1.0);
    let blue = color(dice.between(0.55, 0.62), clear * dice.between(0.3, 0.6), 0.9);
    let pale = color(dice.between(0.05, 0.6), dice.between(0.0, 0.15), 0.98);
    let strength = dice.between(0.35, 0.7);
    Light {
        key: sun(dice),
        key_color: Vec3::new(1.0, 0.94, 0.84) * (clear * dice.between(0.8, 2.6)),
        softness: if clear > 0.4 { 0.03 } else { 0.3 },
        ambient: [blue.lerp(Vec3::ONE, 0.5) * strength, Vec3::new(1.0, 0.95, 0.88) * (strength * 0.4)],
        reach: dice.between(1.0, 2.5),
        fills: Vec::new(),
        sky: [pale * bright, blue * bright],
        clouds: if dice.chance(0.5) { dice.between(0.5, 2.0) } else { 0.0 },
        seed: dice.bits(),
        haze: dice.scale(250.0, 3000.0),
    }
}

/// Sets the exposure by a few rays of two views, as a camera does, with white balance and contrast of its own.
fn expose(dice: &mut Dice, world: &World, light: &Light, path: &Path) -> Exposure {
    let (mut sum, mut count) = (0.0, 0.0);
    for time in [0.2, 0.8] {
        for (origin, direction, distance, number) in path.glance::<METER>(world, time) {
            let normal = if number == SKY { Vec3::ZERO } else { world.normal(number, origin + direction * distance) };
            let end = End { origin, direction, distance, number, normal };
            // Bright sky counts little: cameras are set for the place.
            let seen = light.seen(world, [Some(end), None, None, None], 0.05)[0];
            sum += seen.dot(Vec3::new(0.3, 0.6, 0.1)).clamp(0.005, 1.5).ln();
            count += 1.0;
        }
    }
    let mean: f32 = sum / count;
    let balance = Vec3::new(dice.swing(0.12), dice.swing(0.03), dice.swing(0.14)).map(f32::exp);
    let target = dice.scale(0.16, 0.36);
    Exposure { gain: balance * (target / mean.exp()), contrast: dice.between(0.2, 1.0), fade: dice.between(-0.25, 0.2) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clift_core::step_rng;

    #[test]
    fn frames_of_spread_scenes_differ_in_exposure() {
        let mean = |scene: &RealScene, frame| {
            let rgb = scene.render(&scene.path.camera(0.5, 1.0, 8), frame, [32, 32]).rgb;
            rgb.iter().map(|&value| f64::from(value)).sum::<f64>() / rgb.len() as f64
        };
        let mut num_different = 0;
        for number in 0..40 {
            let scene = RealScene::sample(step_rng(4, number, "test"), number % 2 == 1);
            let exposure = |frame: usize| scene.path.exposure(frame);
            let mut frames: Vec<usize> = (0..16).collect();
            frames.sort_by(|&a, &b| exposure(a).total_cmp(&exposure(b)));
            let [low, high] = [frames[0], frames[15]];
            let ratio = exposure(high) / exposure(low);
            assert!((1.0..3.1).contains(&ratio) && (number % 2 == 1 || ratio == 1.0), "scene {number}: {ratio}");
            if ratio > 1.3 {
                num_different += 1;
                assert!(mean(&scene, high) > mean(&scene, low) + 5.0, "scene {number}");
            }
        }
        assert!(num_different > 3, "{num_different}");
    }
}
