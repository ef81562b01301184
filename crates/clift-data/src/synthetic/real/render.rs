//! Frames: four rays per pixel, one shading per surface of a pixel.

use glam::{DVec3, Vec3};

use crate::geometry::camera::Camera;
use crate::image::rgb_image::RgbImage;
use crate::synthetic::real::light::{End, Light};
use crate::synthetic::real::solid::Rays;
use crate::synthetic::real::world::{SKY, World};

/// Offsets of the four rays of a pixel: a turned square, so that upright and level edges have four steps.
const OFFSETS: [[f64; 2]; 4] = [[0.375, 0.125], [0.875, 0.375], [0.125, 0.625], [0.625, 0.875]];
/// Smallest cosine between normals that one shading stands for.
const SAME_NORMAL: f32 = 0.95;

/// From light to display values.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Exposure {
    /// Exposure with white balance.
    pub gain: Vec3,
    /// Strength of the S-shaped curve, 0 to 1.
    pub contrast: f32,
    /// Share of grey in every colour.
    pub fade: f32,
}

impl Exposure {
    /// Converts linear light to display values in `[0, 1]`.
    pub fn display(&self, light: Vec3) -> Vec3 {
        let light = light * self.gain;
        let grey = light.dot(Vec3::new(0.3, 0.6, 0.1));
        let light = light.lerp(Vec3::splat(grey), self.fade);
        let value = (light * (1.0 + light * 0.12) / (1.0 + light * 0.55)).clamp(Vec3::ZERO, Vec3::ONE).map(f32::sqrt);
        value + (value * value * (3.0 - 2.0 * value) - value) * self.contrast
    }
}

pub(crate) fn render(
    world: &World,
    light: &Light,
    exposure: &Exposure,
    camera: &Camera,
    [width, height]: [usize; 2],
) -> RgbImage {
    let intrinsics = camera.intrinsics_norm.to_pixels(width, height);
    let origin = camera.c2w.translation.as_vec3();
    let pixel = (1.0 / intrinsics.fx) as f32;
    let mut rgb = Vec::with_capacity(width * height * 3);
    for row in 0..height {
        for column in 0..width {
            let directions = OFFSETS.map(|[x, y]| {
                let x = (column as f64 + x - intrinsics.cx) / intrinsics.fx;
                let y = (row as f64 + y - intrinsics.cy) / intrinsics.fy;
                (camera.c2w.rotation * DVec3::new(x, y, 1.0)).as_vec3().normalize()
            });
            let sum = pixel_sum(world, light, exposure, origin, directions, pixel);
            rgb.extend((sum * (255.0 / 4.0)).to_array().map(|value| (value + 0.5) as u8));
        }
    }
    RgbImage { width, height, rgb }
}

/// Returns the sum of the display values along four rays.
fn pixel_sum(
    world: &World,
    light: &Light,
    exposure: &Exposure,
    origin: Vec3,
    directions: [Vec3; 4],
    pixel: f32,
) -> Vec3 {
    let (distances, numbers) = world.nearest(&Rays::new(origin, directions));
    let mut sum = Vec3::ZERO;
    let mut done = [false; 4];
    let normals = [0, 1, 2, 3].map(|lane| match numbers[lane] {
        SKY => Vec3::ZERO,
        number => world.normal(number, origin + directions[lane] * distances[lane]),
    });
    for lane in 0..4 {
        if done[lane] {
            continue;
        }
        let (number, normal) = (numbers[lane], normals[lane]);
        let (mut direction, mut distance, mut count) = (Vec3::ZERO, 0.0, 0.0);
        for other in lane..4 {
            let same = number == SKY || normal.dot(normals[other]) > SAME_NORMAL;
            if numbers[other] == number && same && !done[other] {
                done[other] = true;
                direction += directions[other];
                distance += distances[other];
                count += 1.0;
            }
        }
        let direction = direction.normalize();
        let end = End { origin, direction, distance: distance / count, number, normal };
        sum += exposure.display(light.seen(world, &end, pixel)) * count;
    }
    sum
}
