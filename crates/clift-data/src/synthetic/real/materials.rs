//! Surfaces of walls, floors, furniture, pictures, plants and grounds.

use std::f32::consts::TAU;

use glam::Vec3;

use crate::synthetic::real::builder::Builder;
use crate::synthetic::real::dice::{leaf, stone, wood};
use crate::synthetic::tracing::surface::{Pattern, Surface};

impl Builder {
    fn patterned(&mut self, pattern: Pattern, colors: [Vec3; 3], rate: f32, noise: f32) -> Surface {
        let dice = &mut self.dice;
        let grain = dice.between(0.2, 1.0) * noise;
        Surface {
            pattern,
            colors,
            rate,
            seed: dice.bits(),
            grain,
            grain_rate: dice.scale(0.4, 9.0),
            ..Surface::plain(colors[0])
        }
    }

    pub fn painted(&mut self, color: Vec3, gloss: f32) -> usize {
        let surface = self.patterned(Pattern::Plain, [color; 3], 1.0, 0.16);
        self.surface(Surface { gloss, ..surface })
    }

    pub fn any_paint(&mut self) -> usize {
        let color = self.palette.any(&mut self.dice);
        let gloss = if self.dice.chance(0.3) { self.dice.between(0.1, 0.7) } else { 0.0 };
        self.painted(color, gloss)
    }

    pub fn wall_surface(&mut self) -> usize {
        let base = self.palette.wall(&mut self.dice);
        let second = base * self.dice.between(0.5, 0.92);
        let third = self.palette.any(&mut self.dice);
        let (pattern, rate) = match self.dice.count(0, 15) {
            0 => (Pattern::Stripes { duty: self.dice.between(0.2, 0.8) }, self.dice.scale(1.5, 12.0)),
            1 => (Pattern::Bricks { stretch: 2.5, joint: 0.12, shift: 0.0 }, self.dice.scale(5.0, 13.0)),
            2 => (Pattern::Bricks { stretch: 1.0, joint: 0.04, shift: 0.0 }, self.dice.scale(2.0, 9.0)),
            3 => (Pattern::Plaid { duty: 0.4 }, self.dice.scale(1.0, 6.0)),
            4 => (Pattern::Discs, self.dice.scale(1.0, 5.0)),
            5 => (Pattern::Bricks { stretch: 0.35, joint: 0.03, shift: 0.0 }, self.dice.scale(0.4, 2.0)),
            6 => (Pattern::Clouds { gain: 0.6, sharp: 1.0 }, self.dice.scale(0.4, 2.0)),
            _ => (Pattern::Plain, 1.0),
        };
        let third = if pattern == Pattern::Discs { third } else { base * self.dice.between(0.5, 1.1) };
        let surface = self.patterned(pattern, [base, second, third], rate, 0.14);
        self.surface(surface)
    }

    pub fn floor_surface(&mut self) -> usize {
        let quarter = if self.dice.chance(0.5) { [0.0, 1.0] } else { [1.0, 0.0] };
        let surface = match self.dice.count(0, 9) {
            0..=4 => {
                let base = wood(&mut self.dice);
                let colors = [base, base * self.dice.between(0.45, 0.9), base * 0.3];
                let stretch = self.dice.between(6.0, 14.0);
                let pattern = Pattern::Bricks { stretch, joint: 0.05, shift: 1.0 };
                let rate = self.dice.scale(4.0, 11.0);
                self.patterned(pattern, colors, rate, 0.25)
            }
            5..=6 => {
                let base = if self.dice.chance(0.5) { stone(&mut self.dice) } else { wood(&mut self.dice) };
                let other = if self.dice.chance(0.3) { 0.3 } else { 0.85 };
                let joint = self.dice.between(0.6, 1.2);
                let colors = [base, base * other, base * joint];
                let checks = self.dice.chance(0.25);
                let pattern =
                    if checks { Pattern::Checks } else { Pattern::Bricks { stretch: 1.0, joint: 0.05, shift: 0.0 } };
                let rate = self.dice.scale(1.2, 5.0);
                self.patterned(pattern, colors, rate, 0.2)
            }
            7..=8 => {
                let base = self.palette.muted(&mut self.dice, [0.3, 0.85]);
                let rate = self.dice.scale(0.5, 6.0);
                self.patterned(Pattern::Clouds { gain: 0.8, sharp: 0.6 }, [base, base * 0.7, base], rate, 0.25)
            }
            _ => {
                let base = self.palette.any(&mut self.dice);
                self.patterned(Pattern::Plain, [base; 3], 1.0, 0.3)
            }
        };
        let gloss = if self.dice.chance(0.45) { self.dice.between(0.1, 0.8) } else { 0.0 };
        self.surface(Surface { gloss, turn: quarter, ..surface })
    }

    pub fn board(&mut self) -> usize {
        let base = match self.dice.count(0, 9) {
            0..=5 => wood(&mut self.dice),
            6..=7 => self.palette.muted(&mut self.dice, [0.75, 0.97]),
            _ => self.palette.any(&mut self.dice),
        };
        let pattern = if self.dice.chance(0.6) { Pattern::Grain } else { Pattern::Plain };
        let (rate, dark) = (self.dice.scale(4.0, 20.0), self.dice.between(0.4, 0.85));
        let surface = self.patterned(pattern, [base, base * dark, base], rate, 0.3);
        let gloss = if self.dice.chance(0.4) { self.dice.between(0.05, 0.6) } else { 0.0 };
        self.surface(Surface { gloss, ..surface })
    }

    pub fn cloth(&mut self) -> usize {
        let base = self.palette.any(&mut self.dice);
        let others = [(); 2].map(|()| self.palette.any(&mut self.dice));
        let duty = self.dice.between(0.15, 0.6);
        let (pattern, rate) = match self.dice.count(0, 9) {
            0 => (Pattern::Stripes { duty }, self.dice.scale(3.0, 25.0)),
            1 => (Pattern::Plaid { duty }, self.dice.scale(3.0, 15.0)),
            2 => (Pattern::Discs, self.dice.scale(2.0, 12.0)),
            3 => (Pattern::Clouds { gain: 0.7, sharp: 2.5 }, self.dice.scale(1.5, 8.0)),
            4 => (Pattern::Mosaic, self.dice.scale(0.8, 3.0)),
            5 => (Pattern::Checks, self.dice.scale(3.0, 15.0)),
            _ => (Pattern::Plain, 1.0),
        };
        let surface = self.patterned(pattern, [base, others[0], others[1]], rate, 0.3);
        self.surface(surface)
    }

    pub fn picture(&mut self) -> usize {
        let colors = [(); 3].map(|()| self.palette.any(&mut self.dice));
        let (pattern, rate) = match self.dice.count(0, 9) {
            0..=2 => (Pattern::Mosaic, self.dice.scale(0.6, 2.5)),
            3..=5 => (Pattern::Discs, self.dice.scale(1.0, 4.0)),
            6 => (Pattern::Clouds { gain: 0.6, sharp: 2.0 }, self.dice.scale(1.0, 5.0)),
            7 => (Pattern::Gradient, self.dice.scale(0.7, 2.0)),
            _ => (Pattern::Glyphs, self.dice.scale(1.0, 5.0)),
        };
        let colors = if pattern == Pattern::Glyphs && self.dice.chance(0.7) {
            [Vec3::splat(0.8), colors[1], Vec3::splat(0.05)]
        } else {
            colors
        };
        let surface = self.patterned(pattern, colors, rate, 0.3);
        let gloss = if self.dice.chance(0.4) { self.dice.between(0.1, 0.7) } else { 0.0 };
        self.surface(Surface { gloss, ..surface })
    }

    pub fn books(&mut self) -> usize {
        let colors = [(); 3].map(|()| self.palette.any(&mut self.dice));
        let rate = self.dice.scale(2.0, 4.5);
        let surface = self.patterned(Pattern::Books, colors, rate, 0.1);
        self.surface(surface)
    }

    pub fn foliage(&mut self) -> usize {
        let [base, second] = [(); 2].map(|()| leaf(&mut self.dice));
        let rate = self.dice.scale(5.0, 20.0);
        let pattern = Pattern::Clouds { gain: 0.9, sharp: 2.0 };
        let surface = self.patterned(pattern, [base * 0.3, second * 1.3, base], rate, 0.7);
        self.surface(surface)
    }

    pub fn ground_surface(&mut self) -> usize {
        let surface = match self.dice.count(0, 3) {
            0 => {
                let base = leaf(&mut self.dice);
                let rate = self.dice.scale(0.3, 2.0);
                self.patterned(Pattern::Clouds { gain: 0.85, sharp: 1.2 }, [base, base * 0.5, base], rate, 0.5)
            }
            1 => {
                let base = stone(&mut self.dice);
                let pattern = Pattern::Bricks { stretch: self.dice.between(1.0, 2.2), joint: 0.06, shift: 0.0 };
                let rate = self.dice.scale(0.7, 4.0);
                self.patterned(pattern, [base, base * 0.75, base * 0.5], rate, 0.3)
            }
            _ => {
                let base = stone(&mut self.dice);
                let rate = self.dice.scale(0.2, 1.5);
                self.patterned(Pattern::Clouds { gain: 0.8, sharp: 1.0 }, [base, base * 0.55, base], rate, 0.4)
            }
        };
        self.surface(surface)
    }

    /// Adds a house wall, with windows painted on where `panes`.
    pub fn facade(&mut self, panes: bool) -> usize {
        let base = if self.dice.chance(0.6) {
            stone(&mut self.dice)
        } else {
            self.palette.muted(&mut self.dice, [0.35, 0.95])
        };
        let dark = self.dice.between(0.03, 0.25);
        let frame = base * self.dice.between(0.5, 1.4);
        let [width, height] = [self.dice.between(0.3, 0.75), self.dice.between(0.4, 0.8)];
        let (pattern, rate) = if panes {
            (Pattern::Panes { width, height }, self.dice.scale(0.2, 0.6))
        } else if self.dice.chance(0.5) {
            (Pattern::Bricks { stretch: 2.2, joint: 0.1, shift: 0.0 }, self.dice.scale(1.5, 9.0))
        } else {
            (Pattern::Clouds { gain: 0.7, sharp: 0.5 }, self.dice.scale(0.3, 2.0))
        };
        let second = if panes { Vec3::new(0.9, 1.0, 1.15) * dark } else { base * 0.7 };
        let surface = self.patterned(pattern, [base, second, frame], rate, 0.3);
        self.surface(surface)
    }

    pub fn anything_surface(&mut self) -> usize {
        let number = match self.dice.count(0, 9) {
            0..=2 => self.any_paint(),
            3..=4 => self.board(),
            5..=6 => self.cloth(),
            7 => self.facade(false),
            _ => self.picture(),
        };
        let turn = self.dice.between(0.0, TAU);
        self.surfaces[number].turn = [turn.cos(), turn.sin()];
        number
    }
}
