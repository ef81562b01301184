//! Furniture, plants, trees and piles, put together from boxes, columns and balls.

use std::f32::consts::TAU;

use glam::Vec3;

use crate::synthetic::real::builder::{Builder, Place};
use crate::synthetic::tracing::solid::Shape;

impl Builder {
    pub fn table(&mut self, place: &Place, [wide, deep]: [f32; 2], height: f32) {
        let (top, thick) = (self.board(), self.dice.between(0.02, 0.06));
        let leg = self.dice.between(0.02, 0.05);
        self.block(place, [-wide, wide], [height - thick, height], [-deep, deep], top);
        if self.dice.chance(0.15) {
            self.column(place, [0.0, 0.0], [0.0, height], 0.05, top);
            self.column(place, [0.0, 0.0], [0.0, 0.03], 0.3, top);
        } else {
            for (x, z) in [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)] {
                let (x, z) = (x * (wide - leg), z * (deep - leg));
                self.block(place, [x - leg, x + leg], [0.0, height - thick], [z - leg, z + leg], top);
            }
        }
        let things = self.dice.count(1, 9);
        self.things_on(place, [wide * 0.8, deep * 0.8], height, things);
    }

    pub fn things_on(&mut self, place: &Place, [wide, deep]: [f32; 2], height: f32, count: usize) {
        for _ in 0..count {
            let (x, z) = (self.dice.swing(wide), self.dice.swing(deep));
            let spot = place.then(x, height, z, self.dice.between(0.0, TAU));
            let (size, tall) = (self.dice.scale(0.04, 0.14), self.dice.scale(0.06, 0.35));
            match self.dice.count(0, 5) {
                0 => {
                    let surface = self.any_paint();
                    self.ball(&spot, [0.0, size, 0.0], [size; 3], surface);
                }
                1..=2 => {
                    let surface = self.any_paint();
                    self.column(&spot, [0.0, 0.0], [0.0, tall], size * 0.6, surface);
                }
                3 => self.plant(&spot, tall * 1.5),
                4 => {
                    let surface = self.picture();
                    self.block(&spot, [-size, size], [0.0, 0.03], [-size * 1.3, size * 1.3], surface);
                }
                _ => {
                    let surface = self.anything_surface();
                    self.block(&spot, [-size, size], [0.0, tall], [-size * 0.6, size * 0.6], surface);
                }
            }
        }
    }

    pub fn chair(&mut self, place: &Place) {
        let (frame, seat) = (self.board(), if self.dice.chance(0.5) { self.cloth() } else { self.board() });
        let (half, height, back) =
            (self.dice.between(0.19, 0.25), self.dice.between(0.4, 0.5), self.dice.between(0.75, 1.1));
        self.block(place, [-half, half], [height - 0.05, height], [-half, half], seat);
        for (x, z) in [(-half, -half), (-half, half), (half, -half), (half, half)] {
            let top = if z < 0.0 { back } else { height };
            let (x, z) = (x * 0.92, z * 0.92);
            self.block(place, [x - 0.02, x + 0.02], [0.0, top], [z - 0.02, z + 0.02], frame);
        }
        let low = self.dice.between(height + 0.05, back - 0.15);
        self.block(place, [-half, half], [low, back], [-half, 0.03 - half], seat);
    }

    /// Adds a sofa or an armchair against `z = 0`, with cushions.
    pub fn sofa(&mut self, place: &Place, wide: f32) {
        let cloth = self.cloth();
        let (deep, seat, back) =
            (self.dice.between(0.7, 1.0), self.dice.between(0.35, 0.48), self.dice.between(0.7, 1.0));
        let arm = self.dice.between(0.1, 0.25);
        self.block(place, [-wide, wide], [0.06, seat - 0.13], [0.05, deep], cloth);
        self.block(place, [-wide, wide], [0.06, back], [0.0, 0.22], cloth);
        for side in [-1.0, 1.0] {
            self.block(place, [side * wide, side * (wide - arm)], [0.06, seat + 0.17], [0.0, deep], cloth);
        }
        let seats = ((wide - arm) / 0.35).max(1.0) as usize;
        let step = 2.0 * (wide - arm) / seats as f32;
        for index in 0..seats {
            let x = arm - wide + index as f32 * step;
            self.block(place, [x + 0.01, x + step - 0.01], [seat - 0.13, seat], [0.2, deep + 0.02], cloth);
            if self.dice.chance(0.6) {
                let cushion = self.cloth();
                let middle = x + step * self.dice.between(0.3, 0.7);
                self.ball(place, [middle, seat + 0.2, 0.32], [0.24, 0.2, 0.09], cushion);
            }
        }
    }

    pub fn bed(&mut self, place: &Place) {
        let (frame, sheet, cover) = (self.board(), self.any_paint(), self.cloth());
        let (wide, long, high) = (self.dice.between(0.5, 1.0), 2.0, self.dice.between(0.45, 0.65));
        let head = self.dice.between(0.8, 1.4);
        self.block(place, [-wide, wide], [0.0, head], [0.0, 0.08], frame);
        self.block(place, [-wide, wide], [0.08, high - 0.2], [0.08, long], frame);
        self.block(place, [-wide, wide], [high - 0.2, high], [0.08, long - 0.02], sheet);
        self.block(place, [-wide - 0.02, wide + 0.02], [0.2, high + 0.03], [0.75, long + 0.02], cover);
        for side in [-0.5, 0.5] {
            let pillow = if self.dice.chance(0.5) { self.cloth() } else { sheet };
            self.ball(place, [side * wide, high + 0.1, 0.35], [0.42 * wide, 0.1, 0.22], pillow);
        }
    }

    /// Adds a shelf of boards with books and things, against `z = 0`.
    pub fn shelf(&mut self, place: &Place, wide: f32, high: f32) {
        let (board, deep) = (self.board(), self.dice.between(0.22, 0.4));
        let levels = self.dice.count(2, 6);
        let step = high / levels as f32;
        self.block(place, [-wide, wide], [0.0, high], [0.0, 0.02], board);
        for side in [-1.0, 1.0] {
            self.block(place, [side * wide, side * (wide - 0.03)], [0.0, high], [0.0, deep], board);
        }
        for level in 0..=levels {
            let base = level as f32 * step;
            self.block(place, [-wide, wide], [base, base + 0.03], [0.0, deep], board);
            if level == levels {
                break;
            }
            if self.dice.chance(0.65) {
                let books = self.books();
                let (from, to) = (self.dice.between(-1.0, 0.0) * wide, self.dice.between(0.2, 0.95) * wide);
                let top = base + step * self.dice.between(0.6, 0.9);
                let front = deep * self.dice.between(0.6, 0.9);
                self.block(place, [from, to], [base + 0.03, top], [0.02, front], books);
            } else {
                let count = self.dice.count(1, 6);
                self.things_on(&place.then(0.0, 0.0, deep * 0.5, 0.0), [wide * 0.8, deep * 0.3], base + 0.03, count);
            }
        }
    }

    /// Adds a row of cupboards with doors, handles, and a worktop, against `z = 0`; sometimes a second row above.
    pub fn cupboards(&mut self, place: &Place, wide: f32) {
        let (front, top, metal) = (self.board(), self.board(), self.any_paint());
        let (deep, high) = (self.dice.between(0.4, 0.65), self.dice.between(0.6, 1.0));
        let doors = self.dice.count(2, 5);
        let upper = self.dice.chance(0.45);
        let rows = [Some([0.0, high]), upper.then_some([high + 0.55, high + 1.2])];
        for (row, [low, high]) in rows.into_iter().flatten().enumerate() {
            let deep = if row == 0 { deep } else { 0.6 * deep };
            self.block(place, [-wide, wide], [low, high], [0.0, deep], metal);
            let step = 2.0 * wide / doors as f32;
            for door in 0..doors {
                let x = door as f32 * step - wide;
                self.block(place, [x + 0.01, x + step - 0.01], [low + 0.05, high - 0.02], [deep, deep + 0.025], front);
                let (handle, at) = (x + step * 0.85, 0.5 * (low + high));
                self.block(place, [handle, handle + 0.02], [at, at + 0.15], [deep + 0.03, deep + 0.06], metal);
            }
        }
        self.block(place, [-wide - 0.02, wide + 0.02], [high, high + 0.04], [0.0, deep + 0.04], top);
        let count = self.dice.count(1, 9);
        self.things_on(&place.then(0.0, 0.0, deep * 0.5, 0.0), [wide * 0.9, deep * 0.3], high + 0.04, count);
    }

    /// Adds a picture, mirror, screen or clock on a wall, against `z = 0`.
    pub fn wall_picture(&mut self, place: &Place, height: f32) {
        let (picture, frame) = (self.picture(), self.any_paint());
        let (wide, tall) = (self.dice.scale(0.15, 0.8), self.dice.scale(0.15, 0.6));
        let edge = self.dice.between(0.02, 0.07);
        let (low, high) = (height - tall, height + tall);
        self.block(place, [-wide - edge, wide + edge], [low - edge, high + edge], [0.0, 0.025], frame);
        self.block(place, [-wide, wide], [low, high], [0.0, 0.035], picture);
    }

    pub fn plant(&mut self, place: &Place, size: f32) {
        let (pot, leaves) = (self.any_paint(), self.foliage());
        self.column(place, [0.0, 0.0], [0.0, 0.35 * size], 0.2 * size, pot);
        for _ in 0..self.dice.count(3, 8) {
            let (x, z) = (self.dice.swing(0.25 * size), self.dice.swing(0.25 * size));
            let height = self.dice.between(0.42, 1.0) * size;
            let half = [(); 3].map(|()| self.dice.scale(0.03, 0.22) * size);
            self.ball(place, [x, height, z], half, leaves);
        }
    }

    pub fn tree(&mut self, place: &Place, size: f32) {
        let (bark, leaves) = (self.board(), self.foliage());
        let trunk = 0.03 * size * self.dice.between(0.6, 1.5);
        let lean = [self.dice.swing(0.1) * size, self.dice.swing(0.1) * size];
        self.rod(place, [0.0, 0.0, 0.0], [lean[0], 0.6 * size, lean[1]], trunk, bark);
        for branch in 0..self.dice.count(4, 12) {
            let (x, z) = (lean[0] + self.dice.swing(0.32 * size), lean[1] + self.dice.swing(0.32 * size));
            let height = self.dice.between(0.45, 0.95) * size;
            let half = [(); 3].map(|()| self.dice.between(0.06, 0.2) * size);
            if branch < 4 {
                self.rod(place, [lean[0], 0.4 * size, lean[1]], [x, height, z], 0.4 * trunk, bark);
            }
            self.ball(place, [x, height, z], half, leaves);
        }
    }

    pub fn fence(&mut self, place: &Place, half: f32, high: f32) {
        let (board, radius) = (self.board(), self.dice.between(0.015, 0.05));
        let posts = self.dice.count(4, 14);
        for post in 0..=posts {
            let x = half * (2.0 * post as f32 / posts as f32 - 1.0);
            self.block(place, [x - radius, x + radius], [0.0, high], [-radius, radius], board);
        }
        for rail in [0.97, 0.5] {
            let height = high * rail;
            self.block(place, [-half, half], [height - radius, height + radius], [-radius, radius], board);
        }
    }

    /// Adds steps that rise along z.
    pub fn stairs(&mut self, place: &Place, wide: f32, steps: usize) {
        let (tread, riser) = (self.board(), self.wall_surface());
        for step in 0..steps {
            let (height, z) = (0.18 * (step + 1) as f32, 0.28 * step as f32);
            self.block(place, [-wide, wide], [0.0, height - 0.03], [z, z + 0.3], riser);
            self.block(place, [-wide - 0.02, wide + 0.02], [height - 0.03, height], [z - 0.03, z + 0.3], tread);
        }
        let long = 0.28 * steps as f32;
        self.rod(place, [wide, 0.9, 0.0], [wide, 0.9 + 0.18 * steps as f32, long], 0.03, tread);
        for step in 0..steps {
            let (low, z) = (0.18 * step as f32, 0.28 * step as f32);
            self.rod(place, [wide, low, z], [wide, low + 0.95, z], 0.015, tread);
        }
    }

    /// Adds a pile of random solids within `radius`, of growing height: a thing that means nothing.
    pub fn pile(&mut self, place: &Place, radius: f32, count: usize) {
        let surfaces = [(); 4].map(|()| self.anything_surface());
        let tumbled = self.dice.chance(0.5);
        for index in 0..count {
            let level = index as f32 / count as f32;
            let spread = radius * (1.0 - 0.7 * level);
            let size = radius * self.dice.scale(0.12, 0.55) * (1.0 - 0.4 * level);
            let (x, z) = (self.dice.swing(0.8 * spread), self.dice.swing(0.8 * spread));
            let center = place.point(x, 0.7 * size + level * 1.6 * radius, z);
            let surface = self.dice.pick(&surfaces);
            self.anything(center, size, tumbled, surface);
        }
    }

    pub fn monument(&mut self, place: &Place, radius: f32) {
        let (stone, other) = (self.facade(false), self.anything_surface());
        let mut height = 0.0;
        let mut wide = radius;
        for _ in 0..self.dice.count(1, 5) {
            let tall = radius * self.dice.scale(0.1, 0.9);
            let shape = self.dice.pick(&[Shape::Block, Shape::Column, Shape::Block, Shape::Ball, Shape::Roof]);
            let surface = self.dice.pick(&[stone, other]);
            self.upright(place, shape, [0.0, 0.0], [height, height + tall], [wide, wide], surface);
            height += if shape == Shape::Ball { 0.85 * tall } else { tall };
            wide *= self.dice.between(0.45, 0.95);
        }
        let surface = self.any_paint();
        let top = place.point(0.0, height + 0.6 * wide, 0.0) + Vec3::new(0.0, 0.1 * wide, 0.0);
        self.anything(top, wide, true, surface);
    }
}
