//! Epipolar geometry: of two cameras, and of matches alone.

use super::{Match, WIDTH};
use crate::camera::{Camera, cross, multiply_vector};
use crate::order::{below, step_rng};

/// A 3 x 3 matrix in f64, row-major.
pub type Matrix3 = [[f64; 3]; 3];

/// Most distance of a match from its epipolar lines, in pixels.
const MOST_PX: f64 = 1.5;
/// Samples of eight matches that are tried.
const MAX_TRIES: u64 = 3000;
/// Chance of never drawing eight right matches at which the search ends.
const LEAST_DOUBT: f64 = 1e-4;
/// Fewest matches that say anything: eight fit any geometry, and a few more by chance.
const FEWEST: usize = 20;
/// Least share of the matches; of wrong ones about one in fifty lies on its line.
const LEAST_SHARE: f64 = 0.25;

/// The fundamental matrix of two cameras between pictures of the given (columns, rows), in the units of [`Match`]:
/// `second^T F first = 0` for a point seen at `first` and `second`.
pub fn of_cameras(cameras: [&Camera; 2], sizes: [[usize; 2]; 2]) -> Matrix3 {
    // Both pictures are WIDTH wide; their height keeps the shape of the pixels.
    let inverse_intrinsics = |i: usize| {
        let [columns, rows] = sizes[i].map(|side| side as f64);
        let k = cameras[i].intrinsics_norm;
        let (width, height) = (WIDTH as f64, WIDTH as f64 * rows / columns);
        let (fx, fy, cx, cy) = (k.fx * width, k.fy * height, k.cx * width, k.cy * height);
        [[1.0 / fx, 0.0, -cx / fx], [0.0, 1.0 / fy, -cy / fy], [0.0, 0.0, 1.0]]
    };
    let to_second = cameras[1].c2w.inverse().after(cameras[0].c2w);
    let t = to_second.translation;
    // E = [t]x R, column by column.
    let column = |j: usize| cross(t, [0, 1, 2].map(|i| to_second.rotation[i][j]));
    let columns = [0, 1, 2].map(column);
    let essential: Matrix3 = [0, 1, 2].map(|i| [0, 1, 2].map(|j| columns[j][i]));
    let (first, second) = (inverse_intrinsics(0), inverse_intrinsics(1));
    let product = |a: &Matrix3, b: &Matrix3| crate::camera::multiply(a, b);
    product(&product(&transposed(&second), &essential), &first)
}

fn transposed(m: &Matrix3) -> Matrix3 {
    [0, 1, 2].map(|i| [0, 1, 2].map(|j| m[j][i]))
}

/// The line `a x + b y + c = 0` in the second picture on which a point of the first lies, with unit normal (a, b);
/// `None` for a point at the epipole.
pub fn line(geometry: &Matrix3, point: [f64; 2]) -> Option<[f64; 3]> {
    let line = multiply_vector(geometry, [point[0], point[1], 1.0]);
    let length = line[0].hypot(line[1]);
    (length > 0.0 && length.is_finite()).then(|| line.map(|value| value / length))
}

/// The line in the first picture on which a point of the second lies.
pub fn line_back(geometry: &Matrix3, point: [f64; 2]) -> Option<[f64; 3]> {
    line(&transposed(geometry), point)
}

/// Symmetric epipolar distance in pixels: the mean of the distances of both points to the line of the other.
pub fn epipolar_distance(geometry: &Matrix3, pair: &Match) -> f64 {
    let away = |line: Option<[f64; 3]>, [x, y]: [f64; 2]| line.map_or(0.0, |[a, b, c]| (a * x + b * y + c).abs());
    let there = away(line(geometry, pair.first), pair.second);
    let back = away(line_back(geometry, pair.second), pair.first);
    f64::midpoint(there, back)
}

/// The matches that one geometry explains, found by drawing samples of eight; none where too few agree. Wrong matches
/// are sorted out without a look at any camera, so that cameras can be judged by the rest.
pub(super) fn consistent(matches: &[Match]) -> Vec<Match> {
    if matches.len() < FEWEST {
        return Vec::new();
    }
    let mut rng = step_rng(0, matches.len() as u64, "epipolar geometry");
    let mut best: Vec<Match> = Vec::new();
    let mut tries = 0;
    let mut enough = MAX_TRIES;
    while tries < enough {
        tries += 1;
        let sample: [Match; 8] = std::array::from_fn(|_| matches[below(&mut rng, matches.len())]);
        let geometry = eight_point(&sample);
        let agrees = |pair: &&Match| epipolar_distance(&geometry, pair) < MOST_PX;
        let num_agreeing = matches.iter().filter(agrees).count();
        if num_agreeing > best.len() {
            let share = num_agreeing as f64 / matches.len() as f64;
            let doubt = (1.0 - share.powi(8)).max(f64::MIN_POSITIVE).ln();
            enough = if doubt < 0.0 { MAX_TRIES.min((LEAST_DOUBT.ln() / doubt).ceil() as u64) } else { MAX_TRIES };
            best = matches.iter().filter(agrees).copied().collect();
        }
    }
    let least = FEWEST.max((LEAST_SHARE * matches.len() as f64).ceil() as usize);
    if best.len() < least { Vec::new() } else { best }
}

/// A matrix that eight matches fulfil. Its rank may be three, which sorts out wrong matches as well as rank two does.
fn eight_point(sample: &[Match; 8]) -> Matrix3 {
    // Coordinates around zero and of about one keep the elimination accurate.
    let scale = WIDTH as f64 / 2.0;
    let unit = |[x, y]: [f64; 2]| [x / scale - 1.0, y / scale - 1.0];
    let rows = sample.map(|pair| {
        let ([x, y], [u, v]) = (unit(pair.first), unit(pair.second));
        [u * x, u * y, u, v * x, v * y, v, x, y, 1.0]
    });
    let f = null_vector(rows);
    let inner = [[f[0], f[1], f[2]], [f[3], f[4], f[5]], [f[6], f[7], f[8]]];
    let to_unit = [[1.0 / scale, 0.0, -1.0], [0.0, 1.0 / scale, -1.0], [0.0, 0.0, 1.0]];
    let product = |a: &Matrix3, b: &Matrix3| crate::camera::multiply(a, b);
    product(&product(&transposed(&to_unit), &inner), &to_unit)
}

/// A vector that eight rows of nine send to zero, by elimination with full pivoting. Of many such vectors, as for
/// points of a plane, it is one.
fn null_vector(mut rows: [[f64; 9]; 8]) -> [f64; 9] {
    let mut order: [usize; 9] = std::array::from_fn(|i| i);
    let mut rank = 0;
    while rank < 8 {
        let places = (rank..8).flat_map(|row| (rank..9).map(move |column| (row, column)));
        let largest = places.max_by(|a, b| rows[a.0][a.1].abs().total_cmp(&rows[b.0][b.1].abs()));
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
    order.iter().zip(solution).for_each(|(place, value)| vector[*place] = value);
    vector
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{IntrinsicsNorm, Pose};
    use crate::order::unit;

    /// Two cameras that look at about the same, and points that both see.
    fn scene(num_points: u64) -> ([Camera; 2], Vec<Match>) {
        let intrinsics_norm = IntrinsicsNorm { fx: 0.9, fy: 1.2, cx: 0.5, cy: 0.48 };
        let (sin, cos) = 0.2_f64.sin_cos();
        let turned = [[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]];
        let cameras = [Pose::IDENTITY, Pose { rotation: turned, translation: [-0.7, 0.2, 0.1] }]
            .map(|c2w| Camera { intrinsics_norm, c2w });
        let seen = |camera: &Camera, point: [f64; 3]| {
            let [x, y, z] = camera.c2w.inverse().apply(point);
            let k = camera.intrinsics_norm.to_pixels(640, 480);
            [k.fx * x / z + k.cx, k.fy * y / z + k.cy]
        };
        let matches = (0..num_points).map(|i| {
            let mut rng = step_rng(5, i, "test");
            let point = [2.0 * unit(&mut rng) - 1.0, 1.5 * unit(&mut rng) - 0.7, 3.0 + 2.0 * unit(&mut rng)];
            Match { first: seen(&cameras[0], point), second: seen(&cameras[1], point) }
        });
        let matches = matches.collect();
        (cameras, matches)
    }

    #[test]
    fn points_seen_by_both_cameras_lie_on_each_others_lines() {
        let (cameras, matches) = scene(50);
        let geometry = of_cameras([&cameras[0], &cameras[1]], [[320, 240], [1280, 960]]);
        for pair in &matches {
            assert!(epipolar_distance(&geometry, pair) < 1e-9, "{pair:?}");
            let [a, b, _] = line(&geometry, pair.first).unwrap();
            let beside = Match { second: [pair.second[0] + 3.0 * a, pair.second[1] + 3.0 * b], ..*pair };
            let there = line(&geometry, beside.first).unwrap();
            assert!((there[0] * beside.second[0] + there[1] * beside.second[1] + there[2] - 3.0).abs() < 1e-9);
        }
    }

    #[test]
    fn eight_matches_give_the_geometry_of_the_cameras() {
        let (_, matches) = scene(60);
        let geometry = eight_point(&std::array::from_fn(|i| matches[i]));
        for pair in &matches {
            assert!(epipolar_distance(&geometry, pair) < 1e-6, "{}", epipolar_distance(&geometry, pair));
        }
    }

    #[test]
    fn wrong_matches_are_sorted_out_and_pictures_of_other_places_have_none() {
        let (_, mut matches) = scene(120);
        for (i, pair) in matches.iter_mut().enumerate().filter(|(i, _)| i % 3 == 0) {
            let mut rng = step_rng(6, i as u64, "test");
            pair.second = [640.0 * unit(&mut rng), 480.0 * unit(&mut rng)];
        }
        let kept = consistent(&matches);
        let right = matches.iter().enumerate().filter(|(i, _)| i % 3 != 0).map(|(_, pair)| *pair);
        assert!(right.clone().all(|pair| kept.contains(&pair)));
        assert!(kept.len() < 80 + 8, "{}", kept.len());
        for (i, pair) in matches.iter_mut().enumerate() {
            let mut rng = step_rng(7, i as u64, "test");
            pair.second = [640.0 * unit(&mut rng), 480.0 * unit(&mut rng)];
        }
        assert!(consistent(&matches).is_empty());
        assert!(consistent(&matches[..19]).is_empty());
    }
}
