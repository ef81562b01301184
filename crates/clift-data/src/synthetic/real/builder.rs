//! Puts solids together: boxes, columns and balls relative to a place.

use std::f32::consts::TAU;

use glam::{EulerRot, Mat3, Vec3};

use crate::synthetic::real::dice::{Dice, Palette};
use crate::synthetic::tracing::solid::{Shape, Solid};
use crate::synthetic::tracing::surface::Surface;

/// A spot on a floor with its own right and forward; heights are upwards.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Place {
    /// World position of the origin (y is down).
    pub at: Vec3,
    right: Vec3,
    forward: Vec3,
}

impl Place {
    /// Returns the place at `at` whose forward is `(sin, cos)` of `yaw` in (x, z).
    pub fn turned(at: Vec3, yaw: f32) -> Self {
        Self::facing(at, [yaw.sin(), yaw.cos()])
    }

    /// Returns the place at `at` whose forward is this unit vector in (x, z).
    pub fn facing(at: Vec3, [x, z]: [f32; 2]) -> Self {
        Self { at, right: Vec3::new(z, 0.0, -x), forward: Vec3::new(x, 0.0, z) }
    }

    pub fn point(&self, x: f32, height: f32, z: f32) -> Vec3 {
        self.at + self.right * x + self.forward * z - Vec3::Y * height
    }

    pub fn then(&self, x: f32, height: f32, z: f32, yaw: f32) -> Self {
        let (sin, cos) = yaw.sin_cos();
        let forward = self.forward * cos + self.right * sin;
        Self { at: self.point(x, height, z), right: Vec3::new(forward.z, 0.0, -forward.x), forward }
    }

    fn axes(&self) -> Mat3 {
        Mat3::from_cols(self.right, Vec3::Y, self.forward)
    }
}

pub(crate) struct Builder {
    pub dice: Dice,
    pub palette: Palette,
    pub solids: Vec<Solid>,
    pub surfaces: Vec<Surface>,
}

impl Builder {
    pub fn new(mut dice: Dice) -> Self {
        let palette = Palette::sample(&mut dice);
        Self { dice, palette, solids: Vec::new(), surfaces: Vec::new() }
    }

    pub fn surface(&mut self, surface: Surface) -> usize {
        self.surfaces.push(surface);
        self.surfaces.len() - 1
    }

    /// Adds a box between the corners `x`, `height`, `z` of a place.
    pub fn block(&mut self, place: &Place, x: [f32; 2], height: [f32; 2], z: [f32; 2], surface: usize) {
        let middle = |[low, high]: [f32; 2]| 0.5 * (low + high);
        let half = |[low, high]: [f32; 2]| 0.5 * (high - low).abs();
        let center = place.point(middle(x), middle(height), middle(z));
        let half = Vec3::new(half(x), half(height), half(z));
        self.solids.push(Solid::new(Shape::Block, center, half, place.axes(), surface));
    }

    /// Adds a box whose pattern continues that of all boxes of this kind.
    pub fn piece(&mut self, place: &Place, x: [f32; 2], height: [f32; 2], z: [f32; 2], surface: usize) {
        self.block(place, x, height, z, surface);
        self.solids.last_mut().expect("a box was added").anchor = Vec3::ZERO;
    }

    /// Adds an upright solid of any shape at `(x, z)` between two heights, with half widths along x and z.
    pub fn upright(
        &mut self,
        place: &Place,
        shape: Shape,
        [x, z]: [f32; 2],
        [low, high]: [f32; 2],
        [wide, deep]: [f32; 2],
        surface: usize,
    ) {
        let half = Vec3::new(wide, 0.5 * (high - low), deep);
        let center = place.point(x, 0.5 * (low + high), z);
        self.solids.push(Solid::new(shape, center, half, place.axes(), surface));
    }

    pub fn column(&mut self, place: &Place, at: [f32; 2], heights: [f32; 2], radius: f32, surface: usize) {
        self.upright(place, Shape::Column, at, heights, [radius; 2], surface);
    }

    pub fn ball(&mut self, place: &Place, [x, height, z]: [f32; 3], half: [f32; 3], surface: usize) {
        let heights = [height - half[1], height + half[1]];
        self.upright(place, Shape::Ball, [x, z], heights, [half[0], half[2]], surface);
    }

    pub fn rod(&mut self, place: &Place, from: [f32; 3], to: [f32; 3], radius: f32, surface: usize) {
        let [from, to] = [from, to].map(|[x, height, z]| place.point(x, height, z));
        let along = (to - from).normalize_or(Vec3::Y);
        let side = along.any_orthonormal_vector();
        let axes = Mat3::from_cols(side, along, side.cross(along));
        let half = Vec3::new(radius, 0.5 * from.distance(to), radius);
        self.solids.push(Solid::new(Shape::Column, (from + to) * 0.5, half, axes, surface));
    }

    /// Adds a solid of a random shape, turned at random where `tumbled`, of about `size`, with its middle at a point.
    pub fn anything(&mut self, center: Vec3, size: f32, tumbled: bool, surface: usize) {
        let dice = &mut self.dice;
        let shape = dice.pick(&[Shape::Block, Shape::Block, Shape::Ball, Shape::Column, Shape::Roof]);
        let half = Vec3::new(dice.scale(0.35, 1.2), dice.scale(0.35, 1.2), dice.scale(0.35, 1.2)) * size;
        let tilt = if tumbled { TAU } else { 0.0 };
        let axes =
            Mat3::from_euler(EulerRot::YXZ, dice.between(0.0, TAU), dice.between(0.0, tilt), dice.between(0.0, tilt));
        self.solids.push(Solid::new(shape, center, half, axes, surface));
    }
}
