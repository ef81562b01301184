//! Frames: four rays per pixel, one shading per surface and pixel, in blocks of 2 x 2 pixels.

use clift_core::{Camera, IntrinsicsNorm, RgbImage};
use glam::{Vec3, Vec4};

use crate::synthetic::tracing::light::{End, Light};
use crate::synthetic::tracing::solid::Rays;
use crate::synthetic::tracing::world::{SKY, World};

/// Offsets of the four rays of a pixel: a turned square, so that upright and level edges have four steps.
const OFFSETS_X: Vec4 = Vec4::new(0.375, 0.875, 0.125, 0.625);
const OFFSETS_Y: Vec4 = Vec4::new(0.125, 0.375, 0.625, 0.875);
/// Pixels along each side of a square that shares a list of solids; even.
const TILE: usize = 8;
/// Smallest cosine between normals that one shading stands for.
const SAME_NORMAL: f32 = 0.95;

#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Exposure {
    pub gain: Vec3,
    /// Strength of the S-shaped curve, 0 to 1.
    pub contrast: f32,
    /// Share of grey in every colour.
    pub fade: f32,
}

impl Exposure {
    pub fn display(&self, light: Vec3) -> Vec3 {
        let light = light * self.gain;
        let grey = light.dot(Vec3::new(0.3, 0.6, 0.1));
        let light = light.lerp(Vec3::splat(grey), self.fade);
        let value = (light * (1.0 + light * 0.12) / (1.0 + light * 0.55)).clamp(Vec3::ZERO, Vec3::ONE).map(f32::sqrt);
        value + (value * value * (3.0 - 2.0 * value) - value) * self.contrast
    }
}

/// Visible part of one surface in a block of 2 x 2 pixels.
#[derive(Clone, Copy)]
struct Part {
    number: usize,
    normal: Vec3,
    /// Per pixel: sums of directions and distances, and number of rays.
    pixels: [(Vec3, f32, f32); 4],
}

const NOTHING: Part = Part { number: SKY, normal: Vec3::ZERO, pixels: [(Vec3::ZERO, 0.0, 0.0); 4] };

struct Parts {
    parts: [Part; 16],
    count: usize,
}

pub(crate) fn render(
    world: &World,
    light: &Light,
    exposure: &Exposure,
    camera: &Camera<IntrinsicsNorm>,
    [width, height]: [usize; 2],
) -> RgbImage {
    let intrinsics = camera.intrinsics.to_pixels(width, height);
    let origin = camera.c2w.translation.as_vec3();
    let rotation = camera.c2w.rotation.as_mat3();
    let pixel = (1.0 / intrinsics.fx) as f32;
    let [cx, cy] = [intrinsics.cx as f32, intrinsics.cy as f32];
    let per_row = (1.0 / intrinsics.fy) as f32;
    let slope = |column: usize, row: usize| Vec3::new((column as f32 - cx) * pixel, (row as f32 - cy) * per_row, 1.0);
    let mut rgb = vec![0; width * height * 3];
    let (mut ahead, mut block) = (Vec::new(), Parts { parts: [NOTHING; 16], count: 0 });
    for top in (0..height).step_by(TILE) {
        for left in (0..width).step_by(TILE) {
            let corners =
                [(0, 0), (TILE, 0), (0, TILE), (TILE, TILE)].map(|(x, y)| rotation * slope(left + x, top + y));
            let low = corners.into_iter().fold(Vec3::INFINITY, Vec3::min);
            let high = corners.into_iter().fold(Vec3::NEG_INFINITY, Vec3::max);
            world.tree.ahead(&world.solids, origin, [low, high], &mut ahead);
            for (left, top) in (0..TILE * TILE / 4).map(|at| (left + at % (TILE / 2) * 2, top + at / (TILE / 2) * 2)) {
                let places = [0, 1, 2, 3].map(|index| (left + index % 2, top + index / 2));
                let inside = |(column, row): (usize, usize)| column < width && row < height;
                block.count = 0;
                for (index, (column, row)) in places.into_iter().enumerate().filter(|&(_, place)| inside(place)) {
                    let x = (Vec4::splat(column as f32 - cx) + OFFSETS_X) * pixel;
                    let y = (Vec4::splat(row as f32 - cy) + OFFSETS_Y) * per_row;
                    let rays = Rays::through(origin, &rotation, x, y);
                    block.add(world, origin, &rays, world.nearest_of(&rays, &ahead), index);
                }
                let colors = block.colors(world, light, exposure, origin, pixel);
                for ((column, row), color) in places.into_iter().zip(colors).filter(|&(place, _)| inside(place)) {
                    let values = color.to_array().map(|value| (value * (255.0 / 4.0) + 0.5) as u8);
                    rgb[(row * width + column) * 3..][..3].copy_from_slice(&values);
                }
            }
        }
    }
    RgbImage { width, height, rgb }
}

impl Parts {
    fn add(&mut self, world: &World, origin: Vec3, rays: &Rays, ends: (Vec4, [usize; 4]), pixel: usize) {
        let (distances, numbers) = ends;
        let (distances, directions) = (distances.to_array(), rays.directions());
        for lane in 0..4 {
            let (number, direction, distance) = (numbers[lane], directions[lane], distances[lane]);
            let normal = match number {
                SKY => Vec3::ZERO,
                number => world.normal(number, origin + direction * distance),
            };
            let same = |part: &Part| part.number == number && (number == SKY || part.normal.dot(normal) > SAME_NORMAL);
            let position = self.parts[..self.count].iter().position(same).unwrap_or_else(|| {
                self.parts[self.count] = Part { number, normal, ..NOTHING };
                self.count += 1;
                self.count - 1
            });
            let (sum, far, count) = &mut self.parts[position].pixels[pixel];
            (*sum, *far, *count) = (*sum + direction, *far + distance, *count + 1.0);
        }
    }

    /// Returns the sums of the display values of the rays of each pixel.
    fn colors(&self, world: &World, light: &Light, exposure: &Exposure, origin: Vec3, pixel: f32) -> [Vec3; 4] {
        let mut sums = [Vec3::ZERO; 4];
        for &Part { number, normal, pixels } in &self.parts[..self.count] {
            let ends = pixels.map(|(direction, distance, count)| {
                let direction = direction.normalize_or_zero();
                (count > 0.0).then(|| End { origin, direction, distance: distance / count, number, normal })
            });
            let seen = light.seen(world, ends, pixel);
            for (index, (.., count)) in pixels.into_iter().enumerate().filter(|(_, (.., count))| *count > 0.0) {
                sums[index] += exposure.display(seen[index]) * count;
            }
        }
        sums
    }
}
