//! Descriptors of corners: upright histograms of gradient directions in 4 x 4 cells, as in SIFT, and mutual nearest ones.

use crate::tools::features::corners::GrayImage;

const CELLS: usize = 4;
const DIRECTIONS: usize = 8;
const CELL_PX: f32 = 5.0;
/// Largest component relative to the length. Clipping keeps one strong edge from dominating.
const MAX_COMPONENT: f32 = 0.2;
/// Length of a descriptor; components are integers.
const LENGTH: f32 = 1024.0;

/// A vector of length 1,024, up to rounding.
#[derive(Clone, Debug)]
pub(crate) struct Descriptor {
    values: [i16; CELLS * CELLS * DIRECTIONS],
    square: i32,
}

impl Descriptor {
    /// Describes the surroundings of (x, y), in pixels. Returns `None` near the edge and for a constant surrounding.
    pub fn at(gray: &GrayImage, x: f64, y: f64) -> Option<Self> {
        let half = (CELLS as f32 * CELL_PX / 2.0) as i64 + 1;
        let (column, row) = (x.floor() as i64, y.floor() as i64);
        let inside = |position: i64, size: usize| position - half >= 1 && position + half < size as i64 - 1;
        if !inside(column, gray.width) || !inside(row, gray.height) {
            return None;
        }
        let mut sums = [0.0_f32; CELLS * CELLS * DIRECTIONS];
        for v in row - half..=row + half {
            for u in column - half..=column + half {
                let [dx, dy] = gray.gradient(u as usize, v as usize);
                // Position in cells, 0 at the centre of the first cell.
                let across = ((u as f64 + 0.5 - x) as f32) / CELL_PX + (CELLS as f32 - 1.0) / 2.0;
                let down = ((v as f64 + 0.5 - y) as f32) / CELL_PX + (CELLS as f32 - 1.0) / 2.0;
                let turn = (dy.atan2(dx) / std::f32::consts::TAU).rem_euclid(1.0) * DIRECTIONS as f32;
                add(&mut sums, [across, down, turn], (dx * dx + dy * dy).sqrt());
            }
        }
        let length = |values: &[f32]| values.iter().map(|value| value * value).sum::<f32>().sqrt();
        let whole = length(&sums);
        if whole < 1e-3 {
            return None;
        }
        for value in &mut sums {
            *value = (*value / whole).min(MAX_COMPONENT);
        }
        let cut = length(&sums);
        let values = sums.map(|value| (value / cut * LENGTH).round() as i16);
        let square = values.iter().map(|value| i32::from(*value) * i32::from(*value)).sum();
        Some(Self { values, square })
    }

    pub fn squared_distance(&self, other: &Self) -> i32 {
        let product: i32 = self.values.iter().zip(&other.values).map(|(a, b)| i32::from(*a) * i32::from(*b)).sum();
        self.square + other.square - 2 * product
    }
}

/// Distributes a gradient over the neighbouring cells and directions with linear weights.
fn add(sums: &mut [f32], [across, down, turn]: [f32; 3], strength: f32) {
    let parts = |position: f32| {
        let low = position.floor();
        [(low as i64, 1.0 - (position - low)), (low as i64 + 1, position - low)]
    };
    for (row, by_row) in parts(down) {
        for (column, by_column) in parts(across) {
            if !(0..CELLS as i64).contains(&row) || !(0..CELLS as i64).contains(&column) {
                continue;
            }
            let cell = (row as usize * CELLS + column as usize) * DIRECTIONS;
            for (direction, by_direction) in parts(turn) {
                sums[cell + direction as usize % DIRECTIONS] += strength * by_row * by_column * by_direction;
            }
        }
    }
}

/// Largest distance of the nearest descriptor over that of the second nearest (Lowe's ratio test).
const RATIO: f64 = 0.8;

/// Returns the pairs of mutual nearest descriptors that pass the ratio test both ways, in the order of the first list.
pub(crate) fn match_mutually(first: &[Descriptor], second: &[Descriptor]) -> Vec<(usize, usize)> {
    let mut forward = vec![Nearest::NONE; first.len()];
    let mut backward = vec![Nearest::NONE; second.len()];
    for (a, mine) in first.iter().enumerate() {
        for (b, other) in second.iter().enumerate() {
            let distance = mine.squared_distance(other);
            forward[a].update(b, distance);
            backward[b].update(a, distance);
        }
    }
    let clear = |nearest: &Nearest| nearest.is_clear().then_some(nearest.index);
    let pair = |(a, nearest): (usize, &Nearest)| {
        let b = clear(nearest)?;
        (clear(&backward[b]) == Some(a)).then_some((a, b))
    };
    forward.iter().enumerate().filter_map(pair).collect()
}

/// The nearest descriptor so far, its distance, and the distance of the second nearest.
#[derive(Clone, Copy)]
struct Nearest {
    index: usize,
    distance: i32,
    second: i32,
}

impl Nearest {
    const NONE: Self = Self { index: usize::MAX, distance: i32::MAX, second: i32::MAX };

    fn update(&mut self, index: usize, distance: i32) {
        if distance < self.distance {
            *self = Self { index, distance, second: self.distance };
        } else {
            self.second = self.second.min(distance);
        }
    }

    fn is_clear(&self) -> bool {
        self.index != usize::MAX && f64::from(self.distance) < RATIO * RATIO * f64::from(self.second)
    }
}
