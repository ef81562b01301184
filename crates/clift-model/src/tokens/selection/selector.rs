//! Selection of the tokens for a target view (paper section 3.3, Algorithm 1), on the host.
//!
//! Choices that the paper leaves open: the second step adds only tokens that the first step did not select, the bonus of
//! the previous frame belongs to a token and not to its view, and ties go to the lower id.
// S stored tokens, R rendered tokens, Q cells of the target's grid

use clift_core::{Camera, DVec3};
use glam::Vec3;
use rayon::prelude::*;

use crate::error::ModelError;
use crate::tokens::selection::rules::{DISTANCE_WEIGHT, MOMENTUM, PREVIOUS_BONUS, SelectionRules};
use crate::tokens::selection::token_ray::TokenRay;

const CELLS_PER_TASK: usize = 16;
/// Distances of a row whose minimum is compared with the limit at once.
const GROUP: usize = 32;

/// Selects tokens frame by frame, with the state of the previous frame.
#[derive(Clone, Debug)]
pub struct Selector {
    rules: SelectionRules,
    origins: Vec<DVec3>,
    directions: Directions,
    grid: [usize; 2],
    /// Smoothed distances of the previous frame, `[Q][S]`.
    field: Vec<Vec<f32>>,
    /// Whether a token was selected for the previous frame; empty before the first frame.
    previous: Vec<bool>,
    last_axis: Option<DVec3>,
}

/// Unit directions, one array per coordinate for vectorization.
#[derive(Clone, Debug)]
struct Directions {
    x: Vec<f32>,
    y: Vec<f32>,
    z: Vec<f32>,
}

/// Nearest tokens of the cells of a task.
struct Nearest {
    /// Smallest distance of every token to a cell.
    distance: Vec<f32>,
    selected: Vec<bool>,
    candidates: Vec<(f32, u32)>,
}

impl Selector {
    /// Prepares the tokens of a scene.
    pub fn new(rules: SelectionRules, rays: &[TokenRay]) -> Result<Self, ModelError> {
        let mut directions = Directions { x: Vec::new(), y: Vec::new(), z: Vec::new() };
        for (token, ray) in rays.iter().enumerate() {
            let length = ray.direction.length();
            if !(length > 0.0 && length.is_finite() && ray.origin.is_finite()) {
                let (origin, direction) = (ray.origin.to_array(), ray.direction.to_array());
                return Err(ModelError::BadRay { token, origin, direction });
            }
            let Vec3 { x, y, z } = (ray.direction / length).as_vec3();
            directions.x.push(x);
            directions.y.push(y);
            directions.z.push(z);
        }
        let origins = rays.iter().map(|ray| ray.origin).collect();
        Ok(Self { rules, origins, directions, grid: [0; 2], field: Vec::new(), previous: Vec::new(), last_axis: None })
    }

    /// Forgets the previous frame.
    pub fn reset(&mut self) {
        self.grid = [0; 2];
        self.field.clear();
        self.previous.clear();
        self.last_axis = None;
    }

    /// Replaces the rules and forgets the previous frame.
    pub fn set_rules(&mut self, rules: SelectionRules) {
        self.rules = rules;
        self.reset();
    }

    /// Selects exactly `min(num_render_tokens, num_storage_tokens)` tokens for the next frame, a view of `height` by
    /// `width` pixels, and returns their ids in ascending order. A frame of another size than the previous frame starts
    /// without momentum. Errors: [`ModelError::BadConfig`] for zero tokens, [`ModelError::NotFinite`] for a camera that is not
    /// finite.
    pub fn select(
        &mut self,
        camera: &Camera,
        height: usize,
        width: usize,
        num_render_tokens: usize,
    ) -> Result<Vec<u32>, ModelError> {
        if num_render_tokens == 0 {
            let fix = "write at least 1".into();
            return Err(ModelError::BadConfig { key: "num_render_tokens", value: "0".into(), fix });
        }
        let cells = self.rules.cell_directions(camera, height, width);
        let values = cells.iter().flat_map(DVec3::to_array).chain(camera.c2w.to_matrix_f64());
        if let Some((position, value)) = values.enumerate().find(|(_, value)| !value.is_finite()) {
            return Err(ModelError::NotFinite { name: "the target's camera", value: value as f32, position });
        }
        self.start_frame(camera, &cells, self.rules.grid(height, width));
        let num_storage_tokens = self.origins.len();
        let num_render_tokens = num_render_tokens.min(num_storage_tokens);
        let per_cell = if self.rules.per_cell { num_render_tokens / cells.len() } else { 0 };
        let offsets = self.offsets(camera.c2w.translation);
        let nearest = self.measure(&cells, self.rules.grid(height, width), &offsets, per_cell);
        let chosen = nearest.choose(num_render_tokens);
        self.previous = vec![false; num_storage_tokens];
        for &token in &chosen {
            self.previous[token as usize] = true;
        }
        Ok(chosen)
    }

    /// Forgets the previous frame after a cut: if the camera turned by more than the angle of the central cell.
    fn start_frame(&mut self, camera: &Camera, cells: &[DVec3], [rows, columns]: [usize; 2]) {
        let angle = |a: DVec3, b: DVec3| a.dot(b).clamp(-1.0, 1.0).acos();
        let (axis, middle) = (camera.c2w.rotation.z_axis, rows / 2 * columns + columns / 2);
        let cell = angle(cells[middle], cells[middle - 1]);
        if self.rules.scaled && self.last_axis.is_some_and(|last| angle(last, axis) > cell) {
            self.reset();
        }
        self.last_axis = Some(axis);
    }

    /// Updates the smoothed distances of all tokens to all cells and returns the nearest tokens.
    fn measure(&mut self, cells: &[DVec3], grid: [usize; 2], offsets: &[f32], per_cell: usize) -> Nearest {
        let num_tokens = self.origins.len();
        let momentum = if self.grid == grid && self.rules.per_cell { MOMENTUM } else { 0.0 };
        if self.grid != grid {
            self.grid = grid;
            self.field = vec![vec![0.0; num_tokens]; cells.len()];
        }
        let directions = &self.directions;
        let weigh = |mut found: Nearest, (cell, row): (&DVec3, &mut Vec<f32>)| {
            directions.add_distances(cell.as_vec3(), offsets, momentum, row);
            found.take_smaller(row);
            found.select_nearest(row, per_cell);
            found
        };
        let none = || Nearest::none(num_tokens);
        let cells = cells.par_iter().zip(self.field.par_iter_mut()).with_min_len(CELLS_PER_TASK);
        cells.fold(none, weigh).reduce(none, Nearest::merge)
    }

    /// Returns the part of every token's distance that is equal for all cells.
    fn offsets(&self, target: DVec3) -> Vec<f32> {
        let offset = |(token, origin): (usize, &DVec3)| {
            let has_bonus = self.rules.per_cell && self.previous.get(token) == Some(&true);
            let bonus = if has_bonus { PREVIOUS_BONUS } else { 0.0 };
            DISTANCE_WEIGHT * origin.distance(target) as f32 - bonus
        };
        self.origins.iter().enumerate().map(offset).collect()
    }
}

impl Directions {
    /// Replaces a row by `(1 - momentum) * (angle + offset) + momentum * row`.
    fn add_distances(&self, cell: Vec3, offsets: &[f32], momentum: f32, row: &mut [f32]) {
        let Self { x, y, z } = self;
        let (count, keep) = (row.len(), 1.0 - momentum);
        // Slices of visibly equal length let the compiler omit bounds checks and vectorize.
        let (x, y, z, offsets) = (&x[..count], &y[..count], &z[..count], &offsets[..count]);
        for i in 0..count {
            let (dx, dy, dz) = (x[i] - cell.x, y[i] - cell.y, z[i] - cell.z);
            let distance = angle(dx * dx + dy * dy + dz * dz) + offsets[i];
            row[i] = keep * distance + momentum * row[i];
        }
    }
}

/// Returns the angle in radians between two unit vectors, given the squared length of their difference. The inner product
/// instead would have a rounding error of 3e-4 for equal directions.
///
/// Abramowitz and Stegun 4.4.46 with `x = 1 - u / 2`, mirrored beyond a right angle: an error of 1e-6, about a thousandth of
/// a pixel, and operations that vectorize.
#[inline]
fn angle(squared_chord: f32) -> f32 {
    let is_acute = squared_chord <= 2.0;
    let u = if is_acute { squared_chord } else { (4.0 - squared_chord).max(0.0) };
    let x = 1.0 - 0.5 * u;
    let mut sum = -0.001_262_491_1_f32;
    for coefficient in [0.006_670_09, -0.017_088_126, 0.030_891_88, -0.050_174_303, 0.088_978_99, -0.214_598_8] {
        sum = sum * x + coefficient;
    }
    // Half of pi instead of the book's 1.5707963050, so that both branches meet at a right angle.
    sum = sum * x + std::f32::consts::FRAC_PI_2;
    let angle = (0.5 * u).sqrt() * sum;
    if is_acute { angle } else { std::f32::consts::PI - angle }
}

fn nearer((a, first): (f32, u32), (b, second): (f32, u32)) -> std::cmp::Ordering {
    a.total_cmp(&b).then(first.cmp(&second))
}

/// Keeps the `count` nearest, in any order.
fn keep_nearest(candidates: &mut Vec<(f32, u32)>, count: usize) {
    if count < candidates.len() && count > 0 {
        candidates.select_nth_unstable_by(count - 1, |a, b| nearer(*a, *b));
    }
    candidates.truncate(count);
}

impl Nearest {
    fn none(num_tokens: usize) -> Self {
        Self { distance: vec![f32::INFINITY; num_tokens], selected: vec![false; num_tokens], candidates: Vec::new() }
    }

    fn merge(mut self, other: Self) -> Self {
        self.take_smaller(&other.distance);
        self.selected.iter_mut().zip(&other.selected).for_each(|(a, b)| *a |= *b);
        self
    }

    fn take_smaller(&mut self, distance: &[f32]) {
        for (a, b) in self.distance.iter_mut().zip(distance) {
            *a = if *b < *a { *b } else { *a };
        }
    }

    /// Selects the `count` tokens nearest to a cell (Algorithm 1, first step).
    fn select_nearest(&mut self, row: &[f32], count: usize) {
        if count == 0 {
            return;
        }
        let candidates = &mut self.candidates;
        candidates.clear();
        // Tokens farther than `count` others are skipped, in most cases a group at a time.
        let mut limit = f32::INFINITY;
        for (group, distances) in row.chunks(GROUP).enumerate() {
            let nearest = distances.iter().fold(f32::INFINITY, |least, &d| if d < least { d } else { least });
            if nearest >= limit {
                continue;
            }
            for (i, &distance) in distances.iter().enumerate() {
                if distance < limit {
                    candidates.push((distance, (group * GROUP + i) as u32));
                }
            }
            if candidates.len() >= 4 * count {
                keep_nearest(candidates, count);
                limit = candidates[count - 1].0;
            }
        }
        keep_nearest(candidates, count);
        for &(_, token) in candidates.iter() {
            self.selected[token as usize] = true;
        }
    }

    /// Returns exactly `count` ids: the tokens selected by cells, at most `count`, and the nearest of the others (Algorithm
    /// 1, second step).
    fn choose(&self, count: usize) -> Vec<u32> {
        let listed = |selected: bool| {
            let tokens = (0..self.distance.len()).filter(move |&token| self.selected[token] == selected);
            tokens.map(|token| (self.distance[token], token as u32)).collect::<Vec<_>>()
        };
        let mut chosen = listed(true);
        let mut rest = listed(false);
        keep_nearest(&mut rest, count - chosen.len());
        chosen.append(&mut rest);
        let mut ids: Vec<u32> = chosen.into_iter().map(|(_, token)| token).collect();
        ids.sort_unstable();
        ids
    }
}

#[cfg(test)]
mod tests;
