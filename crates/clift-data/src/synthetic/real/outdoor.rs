//! Streets, gardens and squares, and what is outside a window.

use std::f32::consts::TAU;

use glam::Vec3;

use crate::synthetic::real::builder::{Builder, Place};
use crate::synthetic::tracing::solid::Shape;

impl Builder {
    /// Adds houses, hills, trees and fences on a ground at height `ground` (y is down), from `near` on outwards.
    pub fn surroundings(&mut self, ground: f32, near: f32, count: usize) {
        let town = self.dice.chance(0.7);
        for index in 0..count {
            let angle = TAU * (index as f32 + self.dice.between(0.0, 0.8)) / count as f32;
            let distance = near * self.dice.scale(1.0, 2.8);
            let at = Vec3::new(angle.sin() * distance, ground, angle.cos() * distance);
            let turn = angle + if self.dice.chance(0.7) { 0.0 } else { self.dice.swing(0.8) };
            let place = Place::turned(at, turn);
            match self.dice.count(0, 9) {
                0..=4 if town => self.house(&place, distance),
                0..=1 => {
                    let surface = if self.dice.chance(0.6) { self.foliage() } else { self.ground_surface() };
                    let (wide, tall) =
                        (distance * self.dice.between(0.3, 0.9), distance * self.dice.between(0.06, 0.25));
                    self.ball(&place, [0.0, 0.0, wide], [wide, tall, 0.6 * wide], surface);
                }
                2..=7 => {
                    let size = self.dice.scale(1.5, 9.0);
                    self.tree(&place, size);
                }
                8 => {
                    let (half, high) = (self.dice.between(2.0, 6.0), self.dice.between(0.8, 1.8));
                    self.fence(&place, half, high);
                }
                _ => {
                    let (radius, count) = (self.dice.between(0.4, 1.5), self.dice.count(3, 8));
                    self.pile(&place, radius, count);
                }
            }
        }
    }

    fn house(&mut self, place: &Place, distance: f32) {
        let dice = &mut self.dice;
        let (wide, deep) = (dice.between(2.0, 7.0), dice.between(2.0, 5.0));
        let high = dice.scale(2.6, 12.0);
        let relief = distance < 25.0 && dice.chance(0.75);
        let (wall, roof, trim, glass) = (self.facade(!relief), self.facade(false), self.any_paint(), self.any_paint());
        let front = [0.3, 0.3 + 2.0 * deep];
        self.block(place, [-wide, wide], [0.0, high], front, wall);
        if self.dice.chance(0.6) {
            let top = high + self.dice.between(0.8, 3.0);
            let shape = Shape::Roof;
            self.upright(place, shape, [0.0, 0.3 + deep], [high, top], [wide + 0.3, deep + 0.3], roof);
        } else {
            self.block(place, [-wide - 0.2, wide + 0.2], [high, high + 0.3], [0.1, front[1]], trim);
        }
        if !relief {
            return;
        }
        self.surfaces[glass].gloss = 0.7;
        self.surfaces[glass].colors = [Vec3::splat(0.02); 3];
        let columns = (wide * self.dice.between(0.5, 1.0)).max(1.0) as usize;
        let floors = (high / 2.8).max(1.0) as usize;
        let half = self.dice.between(0.3, 0.6);
        for floor in 0..floors {
            for column in 0..columns {
                let x = 2.0 * wide * (column as f32 + 0.5) / columns as f32 - wide;
                let base = high * floor as f32 / floors as f32;
                let is_door = floor == 0 && column == columns / 2;
                let (low, top) = if is_door { (0.0, 2.1) } else { (base + 0.9, base + 2.2) };
                self.block(place, [x - half - 0.1, x + half + 0.1], [low, top + 0.1], [0.22, 0.3], trim);
                self.block(place, [x - half, x + half], [low, top], [0.2, 0.3], glass);
                if !is_door {
                    self.block(place, [x - 0.03, x + 0.03], [low, top], [0.17, 0.3], trim);
                }
            }
        }
    }

    /// Adds a garden, square or street around the origin, without its surroundings; returns the radius that is taken.
    pub fn open_place(&mut self) -> f32 {
        let radius = self.dice.between(3.0, 7.0);
        for _ in 0..self.dice.count(5, 14) {
            let at = Vec3::new(self.dice.swing(radius), 0.0, self.dice.swing(radius));
            let place = Place::turned(at, self.dice.between(0.0, TAU));
            match self.dice.count(0, 8) {
                0 => {
                    let half = [self.dice.between(0.4, 1.0), 0.4];
                    self.table(&place, half, 0.75);
                }
                1 => self.chair(&place),
                2 => {
                    let size = self.dice.scale(0.5, 3.0);
                    self.plant(&place, size);
                }
                3 => {
                    let size = self.dice.between(2.5, 5.0);
                    self.tree(&place, size);
                }
                4 => {
                    let half = self.dice.between(1.0, 3.0);
                    self.fence(&place, half, 1.0);
                }
                5 => {
                    let wall = self.facade(false);
                    let (half, high) = (self.dice.between(0.5, 3.0), self.dice.between(0.4, 2.5));
                    self.block(&place, [-half, half], [0.0, high], [-0.15, 0.15], wall);
                }
                6 => {
                    let path = self.ground_surface();
                    let (half, long) = (self.dice.between(0.5, 2.0), self.dice.between(2.0, 8.0));
                    self.block(&place, [-half, half], [-0.1, 0.03], [-long, long], path);
                }
                7 => {
                    let steps = self.dice.count(2, 6);
                    self.stairs(&place, 1.0, steps);
                }
                _ => {
                    let (size, count) = (self.dice.between(0.3, 1.2), self.dice.count(3, 8));
                    self.pile(&place, size, count);
                }
            }
        }
        radius
    }
}
