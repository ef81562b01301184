//! Cameras in the pixels of matched corners, epipolar lines, and fundamental matrices of matched corners by RANSAC.

use clift_core::{Camera, IntrinsicsNorm, Pose, step_rng, uniform_below};
use glam::{DMat3, DVec3};

/// Number of columns to which wider images are reduced. Distances are in pixels of this width.
pub const WIDTH: usize = 640;

/// Two corners that show the same point, in pixels of an image [`WIDTH`] columns wide.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Correspondence {
    pub first: [f64; 2],
    pub second: [f64; 2],
}

/// Largest distance of an inlier from its epipolar lines, in pixels.
const MAX_INLIER_PX: f64 = 1.5;
const MAX_TRIES: u64 = 3000;
/// Probability of no all-inlier sample at which the search ends.
const MAX_FAILURE: f64 = 1e-4;
/// Smallest number of inliers: eight fit any geometry, and some more by chance.
const MIN_INLIERS: usize = 20;
/// Smallest share of inliers; about 2 % of wrong matches lie on their line by chance.
const MIN_INLIER_SHARE: f64 = 0.25;

/// Returns the epipolar line `a x + b y + c = 0` in the second image of a point in the first, as `(a, b, c)` with unit
/// normal `(a, b)`; `None` for a point at the epipole.
fn line(geometry: &DMat3, point: [f64; 2]) -> Option<DVec3> {
    let line = *geometry * DVec3::new(point[0], point[1], 1.0);
    let length = line.x.hypot(line.y);
    (length > 0.0 && length.is_finite()).then(|| line / length)
}

/// Returns the symmetric epipolar distance in pixels: the mean distance of each point to the line of the other.
pub fn epipolar_distance(geometry: &DMat3, pair: &Correspondence) -> f64 {
    let away = |line: Option<DVec3>, [x, y]: [f64; 2]| line.map_or(0.0, |line| line.dot(DVec3::new(x, y, 1.0)).abs());
    let in_second = away(line(geometry, pair.first), pair.second);
    let in_first = away(line(&geometry.transpose(), pair.second), pair.first);
    f64::midpoint(in_second, in_first)
}

/// Returns the largest set of matches that agree with one fundamental matrix, by RANSAC with samples of eight. Empty if
/// too few agree. Independent of cameras, so that cameras can be checked against the result.
pub(crate) fn ransac_inliers(matches: &[Correspondence]) -> Vec<Correspondence> {
    if matches.len() < MIN_INLIERS {
        return Vec::new();
    }
    let mut rng = step_rng(0, matches.len() as u64, "epipolar geometry");
    let mut best: Vec<Correspondence> = Vec::new();
    let mut tries = 0;
    let mut enough = MAX_TRIES;
    while tries < enough {
        tries += 1;
        let sample: [Correspondence; 8] = std::array::from_fn(|_| matches[uniform_below(&mut rng, matches.len())]);
        let geometry = eight_point(&sample);
        let agrees = |pair: &&Correspondence| epipolar_distance(&geometry, pair) < MAX_INLIER_PX;
        let num_agreeing = matches.iter().filter(agrees).count();
        if num_agreeing > best.len() {
            let share = num_agreeing as f64 / matches.len() as f64;
            let log_failure = (1.0 - share.powi(8)).max(f64::MIN_POSITIVE).ln();
            enough = if log_failure < 0.0 {
                MAX_TRIES.min((MAX_FAILURE.ln() / log_failure).ceil() as u64)
            } else {
                MAX_TRIES
            };
            best = matches.iter().filter(agrees).copied().collect();
        }
    }
    let least = MIN_INLIERS.max((MIN_INLIER_SHARE * matches.len() as f64).ceil() as usize);
    if best.len() < least { Vec::new() } else { best }
}

/// Returns a matrix that eight matches satisfy. Rank three is accepted and rejects wrong matches as well as rank two.
fn eight_point(sample: &[Correspondence; 8]) -> DMat3 {
    // Coordinates in about [-1, 1] keep the elimination accurate.
    let scale = WIDTH as f64 / 2.0;
    let unit = |[x, y]: [f64; 2]| [x / scale - 1.0, y / scale - 1.0];
    let rows = sample.map(|pair| {
        let ([x, y], [u, v]) = (unit(pair.first), unit(pair.second));
        [u * x, u * y, u, v * x, v * y, v, x, y, 1.0]
    });
    let inner = DMat3::from_rows_array(&null_vector(rows));
    let to_unit = DMat3::from_rows_array(&[1.0 / scale, 0.0, -1.0, 0.0, 1.0 / scale, -1.0, 0.0, 0.0, 1.0]);
    to_unit.transpose() * inner * to_unit
}

/// Returns a null vector of an 8 x 9 matrix by elimination with full pivoting; not unique for points of a plane.
fn null_vector(mut rows: [[f64; 9]; 8]) -> [f64; 9] {
    let mut order: [usize; 9] = std::array::from_fn(|i| i);
    let mut rank = 0;
    while rank < 8 {
        let candidates = (rank..8).flat_map(|row| (rank..9).map(move |column| (row, column)));
        let largest = candidates.max_by(|a, b| rows[a.0][a.1].abs().total_cmp(&rows[b.0][b.1].abs()));
        let Some((row, column)) = largest.filter(|(row, column)| rows[*row][*column].abs() > 1e-9) else { break };
        rows.swap(rank, row);
        for row in &mut rows {
            row.swap(rank, column);
        }
        order.swap(rank, column);
        let pivot = rows[rank];
        for row in &mut rows[rank + 1..] {
            let factor = row[rank] / pivot[rank];
            (rank..9).for_each(|i| row[i] -= factor * pivot[i]);
        }
        rank += 1;
    }
    let mut solution = [0.0; 9];
    solution[8] = 1.0;
    for row in (0..rank).rev() {
        let sum: f64 = (row + 1..9).map(|i| rows[row][i] * solution[i]).sum();
        solution[row] = -sum / rows[row][row];
    }
    let mut vector = [0.0; 9];
    order.iter().zip(solution).for_each(|(index, value)| vector[*index] = value);
    vector
}

/// A camera of an image [`WIDTH`] columns wide, whose height keeps the shape of the pixels.
#[derive(Clone, Copy)]
pub(crate) struct PixelCamera {
    intrinsics: DMat3,
    inverse_intrinsics: DMat3,
    pub c2w: Pose,
}

impl PixelCamera {
    pub fn new(camera: &Camera<IntrinsicsNorm>, [columns, rows]: [usize; 2]) -> Self {
        let k = camera.intrinsics;
        let (width, height) = (WIDTH as f64, WIDTH as f64 * rows as f64 / columns as f64);
        let rows = [k.fx * width, 0.0, k.cx * width, 0.0, k.fy * height, k.cy * height, 0.0, 0.0, 1.0];
        Self::with_intrinsics(DMat3::from_rows_array(&rows), camera.c2w)
    }

    fn with_intrinsics(intrinsics: DMat3, c2w: Pose) -> Self {
        Self { intrinsics, inverse_intrinsics: intrinsics.inverse(), c2w }
    }

    pub fn with_focal_scale(&self, scale: f64) -> Self {
        let scaled = DMat3::from_diagonal(DVec3::new(scale, scale, 1.0));
        let centre = self.intrinsics.z_axis;
        let mut intrinsics = self.intrinsics * scaled;
        intrinsics.z_axis = centre;
        Self::with_intrinsics(intrinsics, self.c2w)
    }

    pub fn ray(&self, [x, y]: [f64; 2]) -> DVec3 {
        self.c2w.rotation * (self.inverse_intrinsics * DVec3::new(x, y, 1.0))
    }

    /// Returns the homogeneous pixel of a point of the world.
    pub fn project(&self, point: DVec3) -> DVec3 {
        self.project_direction(point - self.c2w.translation)
    }

    /// Returns the homogeneous pixel of a direction of the world.
    pub fn project_direction(&self, direction: DVec3) -> DVec3 {
        self.intrinsics * (self.c2w.rotation.transpose() * direction)
    }

    /// Returns the fundamental matrix of two cameras: `second^T F first = 0` for a point seen at `first` and `second`.
    pub fn fundamental(first: &Self, second: &Self) -> DMat3 {
        let Pose { rotation, translation: t } = second.c2w.inverse().after(first.c2w);
        // E = [t]x R, column by column.
        let essential = DMat3::from_cols(t.cross(rotation.x_axis), t.cross(rotation.y_axis), t.cross(rotation.z_axis));
        second.inverse_intrinsics.transpose() * essential * first.inverse_intrinsics
    }
}
