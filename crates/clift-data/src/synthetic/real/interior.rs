//! Rooms with windows, doorways to further rooms, and furniture.

use std::f32::consts::TAU;

use glam::Vec3;

use crate::synthetic::real::builder::{Builder, Place};
use crate::synthetic::tracing::surface::Surface;

const THICK: f32 = 0.15;

#[derive(Clone, Copy, Debug)]
pub(crate) struct Plan {
    pub center: [f32; 2],
    pub half: [f32; 2],
    pub height: f32,
}

/// Surfaces that the rooms of a flat share.
#[derive(Clone, Copy)]
struct Finish {
    floor: usize,
    ceiling: usize,
    wall: usize,
    trim: usize,
}

/// A hole in a wall: from, to, bottom, top.
#[derive(Clone, Copy, Debug)]
struct Opening {
    x: [f32; 2],
    height: [f32; 2],
}

impl Plan {
    /// Returns the middle of a wall's foot, facing inwards, and half the length of the wall.
    fn side(&self, side: usize) -> (Place, f32) {
        let [x, z] = self.center;
        let [wide, deep] = self.half;
        let ([x, z], inwards, long) = [
            ([x - wide, z], [1.0, 0.0], deep),
            ([x + wide, z], [-1.0, 0.0], deep),
            ([x, z - deep], [0.0, 1.0], wide),
            ([x, z + deep], [0.0, -1.0], wide),
        ][side];
        (Place::facing(Vec3::new(x, 0.0, z), inwards), long)
    }
}

impl Builder {
    /// Adds a room with its neighbours and returns its plan and its windows (middle of each).
    pub fn flat(&mut self) -> (Plan, Vec<Vec3>) {
        let dice = &mut self.dice;
        let half = [dice.scale(1.5, 4.5), dice.scale(1.5, 4.5)];
        let plan = Plan { center: [0.0; 2], half, height: dice.between(2.3, 3.6) };
        let mut windows = Vec::new();
        let finish = self.finish();
        self.room(&plan, &finish, 0, None, &mut windows);
        (plan, windows)
    }

    fn finish(&mut self) -> Finish {
        let white = self.palette.muted(&mut self.dice, [0.85, 0.98]);
        let trim = if self.dice.chance(0.6) { self.painted(white, 0.0) } else { self.board() };
        let ceiling = if self.dice.chance(0.85) { self.painted(white, 0.0) } else { self.board() };
        Finish { floor: self.floor_surface(), ceiling, wall: self.wall_surface(), trim }
    }

    fn room(&mut self, plan: &Plan, finish: &Finish, depth: usize, from: Option<usize>, windows: &mut Vec<Vec3>) {
        let Plan { center: [x, z], half: [wide, deep], height } = *plan;
        let whole = Place::facing(Vec3::new(x, 0.0, z), [0.0, 1.0]);
        // Up to the middle of the walls, where the floor of a neighbour begins.
        let [across, along] = [wide, deep].map(|half| [-half - 0.5 * THICK, half + 0.5 * THICK]);
        self.piece(&whole, across, [-0.1, 0.0], along, finish.floor);
        self.piece(&whole, across, [height, height + 0.2], along, finish.ceiling);
        self.on_ceiling(&whole, plan, finish);
        let other = self.wall_surface();
        let accent = self.dice.count(0, 7);
        for side in (0..4).filter(|&side| from != Some(side)) {
            let (place, long) = plan.side(side);
            let surface = if side == accent { other } else { finish.wall };
            let choice = self.dice.between(0.0, 1.0) + 0.15 * depth as f32;
            let openings = if choice < 0.38 && depth < 2 {
                let opening = self.passage(long, height);
                self.neighbour(plan, side, opening, finish, depth, windows);
                vec![opening]
            } else if choice < 0.7 {
                self.windows(&place, long, height, finish, windows)
            } else {
                Vec::new()
            };
            self.wall(&place, long, height, &openings, surface, finish.trim);
            if depth < 2 {
                self.furnish(&place, long, &openings, depth);
            }
        }
        if depth < 2 {
            self.middle(plan);
        }
    }

    fn passage(&mut self, long: f32, height: f32) -> Opening {
        let dice = &mut self.dice;
        let half = if dice.chance(0.5) { dice.between(0.38, 0.55) } else { dice.between(0.6, 0.9 * long.max(0.7)) };
        let half = half.min(0.95 * long);
        let middle = dice.swing((long - half).max(0.0));
        Opening { x: [middle - half, middle + half], height: [0.0, dice.between(1.95, height.min(2.6))] }
    }

    fn neighbour(
        &mut self,
        plan: &Plan,
        side: usize,
        opening: Opening,
        finish: &Finish,
        depth: usize,
        windows: &mut Vec<Vec3>,
    ) {
        let (place, long) = plan.side(side);
        let half_hole = 0.5 * (opening.x[1] - opening.x[0]);
        let half = self.dice.between(half_hole.min(long), long).max(0.6);
        let middle = (0.5 * (opening.x[0] + opening.x[1])).clamp((half - long).min(0.0), (long - half).max(0.0));
        let deep = self.dice.between(0.8, 3.0);
        let center = place.point(middle, 0.0, -THICK - deep);
        let half = if side < 2 { [deep, half] } else { [half, deep] };
        let height = self.dice.between(opening.height[1], plan.height);
        let mut own = *finish;
        if self.dice.chance(0.6) {
            own.wall = self.wall_surface();
        }
        if self.dice.chance(0.4) {
            own.floor = self.floor_surface();
        }
        let back = [1, 0, 3, 2][side];
        self.room(&Plan { center: [center.x, center.z], half, height }, &own, depth + 1, Some(back), windows);
    }

    fn windows(
        &mut self,
        place: &Place,
        long: f32,
        height: f32,
        finish: &Finish,
        windows: &mut Vec<Vec3>,
    ) -> Vec<Opening> {
        let count = self.dice.count(1, (long / 0.9).clamp(1.0, 4.0) as usize);
        let step = 2.0 * long / count as f32;
        let share = self.dice.between(0.35, 0.9);
        let sill = if self.dice.chance(0.25) { 0.02 } else { self.dice.between(0.5, 1.1) };
        let head = self.dice.between(1.9, height - 0.1);
        let bars = [self.dice.count(0, 3), self.dice.count(0, 3)];
        let curtain = self.dice.chance(0.35).then(|| self.cloth());
        let mut openings = Vec::new();
        for index in 0..count {
            let middle = (index as f32 + 0.5) * step - long;
            let half = 0.5 * share * step;
            let (low, high) = (middle - half, middle + half);
            openings.push(Opening { x: [low, high], height: [sill, head] });
            windows.push(place.point(middle, 0.5 * (sill + head), 0.1));
            let bar = 0.025;
            let frame = [-0.1, -0.05];
            for bar_x in 0..=bars[0] + 1 {
                let x = low + 2.0 * half * bar_x as f32 / (bars[0] + 1) as f32;
                self.block(place, [x - bar, x + bar], [sill, head], frame, finish.trim);
            }
            for bar_y in 0..=bars[1] + 1 {
                let y = sill + (head - sill) * bar_y as f32 / (bars[1] + 1) as f32;
                self.block(place, [low, high], [y - bar, y + bar], frame, finish.trim);
            }
            self.block(place, [low - 0.05, high + 0.05], [sill - 0.04, sill], [-0.1, 0.08], finish.trim);
            if let Some(curtain) = curtain {
                let wide = self.dice.between(0.08, 0.25) * (high - low) + 0.05;
                for edge in [low - 0.05, high + 0.05 - wide] {
                    let folds = (wide / 0.07).max(2.0) as usize;
                    for fold in 0..folds {
                        let x = edge + wide * (fold as f32 + 0.5) / folds as f32;
                        let radius = 0.55 * wide / folds as f32;
                        self.column(place, [x, 0.08], [0.03, head + 0.1], radius, curtain);
                    }
                }
                self.rod(place, [low - 0.1, head + 0.1, 0.08], [high + 0.1, head + 0.1, 0.08], 0.02, finish.trim);
            }
        }
        openings
    }

    fn wall(&mut self, place: &Place, long: f32, height: f32, openings: &[Opening], surface: usize, trim: usize) {
        let z = [-THICK, 0.0];
        let mut start = -long - THICK;
        for opening in openings {
            let [from, to] = opening.x;
            let [sill, head] = opening.height;
            self.piece(place, [start, from], [0.0, height], z, surface);
            self.piece(place, [from, to], [head, height], z, surface);
            if sill > 0.0 {
                self.piece(place, [from, to], [0.0, sill], z, surface);
            }
            let frame = [-THICK - 0.02, 0.02];
            for [x, y] in [[from - 0.06, from + 0.01], [to - 0.01, to + 0.06]] {
                self.block(place, [x, y], [sill, head + 0.06], frame, trim);
            }
            self.block(place, [from, to], [head - 0.01, head + 0.06], frame, trim);
            start = to;
        }
        self.piece(place, [start, long + THICK], [0.0, height], z, surface);
        let skirting = self.dice.between(0.05, 0.15);
        let mut start = -long;
        for opening in openings.iter().filter(|opening| opening.height[0] < skirting) {
            self.block(place, [start, opening.x[0] - 0.06], [0.0, skirting], [0.0, 0.02], trim);
            start = opening.x[1] + 0.06;
        }
        self.block(place, [start, long], [0.0, skirting], [0.0, 0.02], trim);
        if self.dice.chance(0.4) {
            self.block(place, [-long, long], [height - 0.09, height], [0.0, 0.05], trim);
        }
    }

    fn on_ceiling(&mut self, place: &Place, plan: &Plan, finish: &Finish) {
        let Plan { half: [wide, deep], height, .. } = *plan;
        let glow = self.surface(Surface { glow: 3.0, ..Surface::plain(Vec3::new(1.0, 0.93, 0.8)) });
        match self.dice.count(0, 5) {
            0 => {
                for index in 0..self.dice.count(2, 8) {
                    let (x, z) = (wide * (index % 2) as f32 - 0.5 * wide, deep * (0.8 - 0.45 * (index / 2) as f32));
                    self.column(place, [x, z], [height - 0.02, height], 0.07, glow);
                }
            }
            1 => {
                let low = height - self.dice.between(0.4, 1.0);
                let shade = if self.dice.chance(0.5) { glow } else { self.any_paint() };
                self.rod(place, [0.0, low, 0.0], [0.0, height, 0.0], 0.015, finish.trim);
                let size = self.dice.between(0.1, 0.3);
                self.ball(place, [0.0, low, 0.0], [size, size * 0.7, size], shade);
            }
            2 => {
                for beam in 0..self.dice.count(2, 5) {
                    let z = deep * (0.4 * beam as f32 - 0.8);
                    self.block(place, [-wide, wide], [height - 0.18, height], [z - 0.07, z + 0.07], finish.trim);
                }
            }
            _ => self.column(place, [0.0, 0.0], [height - 0.1, height], 0.2, glow),
        }
    }

    fn furnish(&mut self, place: &Place, long: f32, openings: &[Opening], depth: usize) {
        let mut start = -long + 0.05;
        while start < long - 0.4 {
            let wide = self.dice.between(0.25, 1.2).min(0.5 * (long - start));
            let middle = start + wide;
            let free = |opening: &&Opening| opening.x[0] < middle + wide && opening.x[1] > middle - wide;
            let hole = openings.iter().find(free);
            let low_only = hole.is_some_and(|hole| hole.height[0] > 0.4);
            let spot = place.then(middle, 0.0, 0.02, 0.0);
            start = middle + wide + self.dice.between(0.05, 0.8);
            if hole.is_some() && !low_only {
                start = hole.map_or(start, |hole| hole.x[1] + 0.1);
                continue;
            }
            if !low_only && self.dice.chance(0.55) {
                let height = self.dice.between(1.3, 1.8);
                self.wall_picture(&place.then(middle, 0.0, 0.0, 0.0), height);
            }
            match self.dice.count(0, 12 + 5 * depth) {
                0..=1 => self.cupboards(&spot, wide),
                2 if !low_only => {
                    let high = self.dice.between(1.0, 2.2);
                    self.shelf(&spot, wide, high);
                }
                3..=4 => self.sofa(&spot, wide.max(0.4)),
                5 => self.bed(&spot),
                6 if !low_only => {
                    let (board, high, deep) = (self.board(), self.dice.between(1.2, 2.2), self.dice.between(0.3, 0.65));
                    self.block(&spot, [-wide, wide], [0.0, high], [0.0, deep], board);
                    let trim = self.any_paint();
                    self.block(&spot, [-0.01, 0.01], [0.05, high - 0.05], [deep, deep + 0.01], trim);
                }
                7 => {
                    let deep = self.dice.between(0.2, 0.4);
                    let high = self.dice.between(0.4, 0.9);
                    self.table(&spot.then(0.0, 0.0, deep, 0.0), [wide, deep], high);
                    self.chair(&spot.then(0.0, 0.0, 2.0 * deep + 0.2, 0.5 * TAU));
                }
                8 => {
                    let size = self.dice.between(0.6, 1.7);
                    self.plant(&spot.then(0.0, 0.0, 0.3, 0.0), size);
                }
                9 => {
                    let count = self.dice.count(2, 7);
                    let radius = wide.min(0.4);
                    self.pile(&spot.then(0.0, 0.0, radius, 0.0), radius, count);
                }
                10 => {
                    let steps = self.dice.count(4, 12);
                    let turn = self.dice.pick(&[-1.0, 1.0]) * 0.25 * TAU;
                    self.stairs(&spot.then(0.0, 0.0, 0.5, turn), 0.45, steps);
                }
                _ => {}
            }
        }
    }

    fn middle(&mut self, plan: &Plan) {
        let Plan { center: [x, z], half: [wide, deep], .. } = *plan;
        let count = self.dice.count(0, if wide * deep > 5.0 { 4 } else { 2 });
        for _ in 0..count {
            let at = Vec3::new(x + self.dice.swing(0.6 * wide), 0.0, z + self.dice.swing(0.6 * deep));
            let turn = if self.dice.chance(0.7) {
                0.25 * TAU * self.dice.count(0, 3) as f32
            } else {
                self.dice.between(0.0, TAU)
            };
            let place = Place::turned(at, turn);
            match self.dice.count(0, 7) {
                0..=2 => {
                    let half = [self.dice.between(0.3, 0.9), self.dice.between(0.3, 0.5)];
                    let high = if self.dice.chance(0.5) { self.dice.between(0.7, 0.8) } else { 0.42 };
                    self.table(&place, half, high);
                    if high > 0.5 {
                        for seat in 0..self.dice.count(1, 4) {
                            let (x, side) = (self.dice.swing(half[0] * 0.7), if seat % 2 == 0 { 1.0 } else { -1.0 });
                            let turn = if side > 0.0 { 0.5 * TAU } else { 0.0 };
                            self.chair(&place.then(x, 0.0, side * (half[1] + 0.25), turn));
                        }
                    }
                }
                3 => {
                    let rug = self.cloth();
                    let (half, deep) = (self.dice.between(0.6, 1.5), self.dice.between(0.4, 1.0));
                    self.block(&place, [-half, half], [0.0, 0.015], [-deep, deep], rug);
                }
                4 => {
                    let half = self.dice.between(0.4, 1.1);
                    self.sofa(&place, half);
                }
                5 => {
                    let half = self.dice.between(0.4, 1.0);
                    self.cupboards(&place, half);
                }
                6 => {
                    let surface = self.anything_surface();
                    self.column(&place, [0.0, 0.0], [0.0, plan.height], 0.15, surface);
                }
                _ => {
                    let count = self.dice.count(3, 10);
                    self.pile(&place, 0.35, count);
                }
            }
        }
    }
}
