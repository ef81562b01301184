//! Prediction of coefficients from earlier tokens of the same view.
//!
//! Neighbouring patches have similar tokens. A coefficient is expected at `w a + v b`, where `a` and `b` are those of the two
//! nearest tokens before it. The weights and the deviation from the expected value depend on the direction, and on how far
//! away the nearest token is.
// S tokens, D width, C classes

use crate::codec::transform::Transform;

/// Largest squared distances, in patches, of the nearest earlier token in the first classes. The next class has those
/// farther away, the last the first token of every view.
const LIMITS: [u32; 4] = [1, 2, 5, 13];
pub(crate) const NUM_CLASSES: usize = LIMITS.len() + 2;
/// Largest magnitude of an expected level.
const MAX_EXPECTED: f64 = (1 << 29) as f64;
/// Share of the variance of neighbours that is added to them in the fit: few tokens do not determine the weights.
const RIDGE: f64 = 1e-3;
/// Smallest deviation from the expected value, over the deviation of the coefficient.
const MIN_SCALE: f64 = 1e-2;

/// The patches of the context views that tokens stand on.
#[derive(Clone, Copy, Debug)]
pub struct Places<'a> {
    /// Patch of every token, counted over views, rows and columns.
    pub ids: &'a [u32],
    /// Number of views, and of rows and columns of patches of a view.
    pub grid: [usize; 3],
}

impl Places<'_> {
    /// Returns the positions of the tokens in the order of their ids.
    pub(crate) fn order(&self) -> Vec<usize> {
        let mut order: Vec<usize> = (0..self.ids.len()).collect();
        order.sort_by_key(|&token| self.ids[token]);
        order
    }

    /// Returns rows `[S, D]` in the order of ids, and their neighbours.
    pub(crate) fn sorted(&self, rows: &[f32], dim: usize) -> (Vec<f32>, Neighbours) {
        let order = self.order();
        let ids: Vec<u32> = order.iter().map(|&token| self.ids[token]).collect();
        let rows = order.iter().flat_map(|&token| &rows[token * dim..(token + 1) * dim]).copied().collect();
        (rows, neighbours(&ids, self.grid))
    }
}

/// Class of every token, and its two nearest earlier tokens: both the same if there is one, the token itself if there is none.
pub(crate) type Neighbours = Vec<(usize, [usize; 2])>;

/// Finds the neighbours of tokens with ascending ids. Of equally near ones, the later is nearer.
pub(crate) fn neighbours(ids: &[u32], [_, rows, columns]: [usize; 3]) -> Neighbours {
    let place = |id: u32| {
        let id = id as usize;
        [id / (rows * columns), id / columns % rows, id % columns]
    };
    let of_token = |(token, &id): (usize, &u32)| {
        let [view, row, column] = place(id);
        let mut nearest = [(usize::MAX, token); 2];
        for earlier in (0..token).rev() {
            let [other, r, c] = place(ids[earlier]);
            let below = (row - r.min(row)).pow(2);
            if other != view || below > nearest[1].0 {
                break;
            }
            let distance = below + column.abs_diff(c).pow(2);
            if distance < nearest[0].0 {
                nearest = [(distance, earlier), nearest[0]];
            } else if distance < nearest[1].0 {
                nearest[1] = (distance, earlier);
            }
        }
        let [(distance, first), (_, second)] = nearest;
        let class = match distance {
            usize::MAX => NUM_CLASSES - 1,
            _ => LIMITS.iter().position(|limit| distance <= *limit as usize).unwrap_or(LIMITS.len()),
        };
        (class, [first, if second == token { first } else { second }])
    };
    ids.iter().enumerate().map(of_token).collect()
}

#[derive(Clone, Debug, PartialEq)]
pub struct Prediction {
    /// Weights of the nearest and of the second nearest earlier token, `[C, D, 2]`.
    pub weights: Vec<f32>,
    /// Deviations from the expected values, in deviations of the coefficients, `[C, D]`.
    pub scales: Vec<f32>,
}

impl Prediction {
    /// Expects every coefficient at the mean.
    pub(crate) fn none(dim: usize) -> Self {
        Self { weights: vec![0.0; NUM_CLASSES * dim * 2], scales: vec![1.0; NUM_CLASSES * dim] }
    }

    fn dim(&self) -> usize {
        self.scales.len() / NUM_CLASSES
    }

    fn weights(&self, class: usize, direction: usize) -> [f64; 2] {
        let start = 2 * (class * self.dim() + direction);
        [self.weights[start], self.weights[start + 1]].map(f64::from)
    }

    /// Returns the expected coefficient of a token whose neighbours have these.
    pub(crate) fn value(&self, class: usize, direction: usize, [first, second]: [f64; 2]) -> f64 {
        let [w, v] = self.weights(class, direction);
        w * first + v * second
    }

    /// Returns the expected level of a token whose neighbours have these levels.
    pub(crate) fn level(&self, class: usize, direction: usize, nearest: [i32; 2]) -> i32 {
        let expected = self.value(class, direction, nearest.map(f64::from)) + 0.5;
        expected.floor().clamp(-MAX_EXPECTED, MAX_EXPECTED) as i32
    }

    /// Returns the standard deviation around the expected value at a step: that of the fit, and that of the rounding of the
    /// neighbours. Both it and `step` are in standard deviations of the coefficient.
    pub(crate) fn deviation(&self, class: usize, direction: usize, step: f64) -> f64 {
        let [w, v] = self.weights(class, direction);
        let scale = f64::from(self.scales[class * self.dim() + direction]);
        let rounding = (w.abs() + v.abs()) * (w.abs() + v.abs()) * (step * step / 12.0).min(1.0);
        (scale * scale + rounding).sqrt()
    }
}

/// Sums of the products of coefficients with those of their neighbours, weighted by scene.
#[derive(Clone, Debug)]
pub struct NeighbourProducts {
    /// Of every class and direction: `a a`, `a b`, `b b`, `a x`, `b x` and `x x`, and the weight.
    sums: Vec<[f64; 7]>,
    dim: usize,
}

impl NeighbourProducts {
    pub fn new(dim: usize) -> Self {
        Self { sums: vec![[0.0; 7]; NUM_CLASSES * dim], dim }
    }

    pub fn add(&mut self, transform: &Transform, tokens: &[f32], places: Places<'_>) {
        let dim = self.dim;
        let (values, neighbours) = places.sorted(&transform.forward(tokens), dim);
        let weight = dim as f64 / tokens.len() as f64;
        for (token, (class, [first, second])) in neighbours.into_iter().enumerate() {
            for direction in 0..dim {
                let [x, a, b] = [token, first, second].map(|token| f64::from(values[token * dim + direction]));
                let sums = &mut self.sums[class * dim + direction];
                let products = [a * a, a * b, b * b, a * x, b * x, x * x, 1.0];
                sums.iter_mut().zip(products).for_each(|(sum, product)| *sum += weight * product);
            }
        }
    }

    /// Returns the weights of the least squared deviations from the expected values.
    pub fn prediction(&self, transform: &Transform) -> Prediction {
        let mut fitted = Prediction::none(self.dim);
        for class in 0..NUM_CLASSES {
            for (direction, &deviation) in transform.deviations.iter().enumerate() {
                let at = class * self.dim + direction;
                let [aa, ab, bb, ax, bx, xx, weight] = self.sums[at];
                let variance = f64::from(deviation).powi(2);
                if weight == 0.0 || class == NUM_CLASSES - 1 {
                    continue;
                }
                let ridge = RIDGE * weight * variance;
                let [aa_ridge, bb_ridge] = [aa + ridge, bb + ridge];
                let determinant = aa_ridge * bb_ridge - ab * ab;
                let w = (ax * bb_ridge - bx * ab) / determinant;
                let v = (bx * aa_ridge - ax * ab) / determinant;
                let left = xx - 2.0 * (w * ax + v * bx) + w * w * aa + 2.0 * w * v * ab + v * v * bb;
                let scale = (left / (weight * variance)).max(0.0).sqrt();
                if w.is_finite() && v.is_finite() && scale.is_finite() {
                    fitted.weights[2 * at..2 * at + 2].copy_from_slice(&[w as f32, v as f32]);
                    fitted.scales[at] = scale.max(MIN_SCALE) as f32;
                }
            }
        }
        fitted
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_pairs_give_the_same_neighbours() {
        let ids: Vec<u32> = (0..120).filter(|id| (id * id) % 7 < 3).collect();
        let found = neighbours(&ids, [2, 6, 10]);
        for (token, (_, nearest)) in found.into_iter().enumerate() {
            let place = |token: usize| [ids[token] / 60, ids[token] / 10 % 6, ids[token] % 10].map(i64::from);
            let [view, row, column] = place(token);
            let mut earlier: Vec<(i64, std::cmp::Reverse<usize>)> = (0..token)
                .filter(|&other| place(other)[0] == view)
                .map(|other| {
                    ((place(other)[1] - row).pow(2) + (place(other)[2] - column).pow(2), std::cmp::Reverse(other))
                })
                .collect();
            earlier.sort_unstable();
            let expected = match earlier[..] {
                [] => [token; 2],
                [(_, only)] => [only.0; 2],
                [(_, first), (_, second), ..] => [first.0, second.0],
            };
            assert_eq!(nearest, expected, "token {token}");
        }
    }

    #[test]
    fn weights_of_a_plane_are_found() {
        // Coefficients that grow along the columns: x = 2 a - b for the left neighbours of a row.
        let transform = Transform { mean: vec![0.0; 2], basis: vec![1.0, 0.0, 0.0, 1.0], deviations: vec![3.0, 1.0] };
        let mut products = NeighbourProducts::new(2);
        let ids: Vec<u32> = (0..8).collect();
        for slope in [0.5, -1.0, 2.0, 1.5] {
            let tokens: Vec<f32> = (0..8).flat_map(|column| [slope * column as f32, 0.0]).collect();
            products.add(&transform, &tokens, Places { ids: &ids, grid: [1, 1, 8] });
        }
        let fitted = products.prediction(&transform);
        let [w, v] = fitted.weights(0, 0);
        assert!((1.5..2.01).contains(&w) && (-1.01..-0.4).contains(&v), "{w} {v}");
        assert_eq!(fitted.weights(0, 1), [0.0; 2]);
        assert!(fitted.scales[0] < 0.3, "{:?}", fitted.scales);
        assert_eq!(fitted.weights(NUM_CLASSES - 1, 0), [0.0; 2]);
        assert_eq!(fitted.level(0, 0, [10, 5]), (10.0 * w + 5.0 * v + 0.5).floor() as i32);
        assert!(fitted.deviation(0, 0, 1.0) > fitted.deviation(0, 0, 0.1));
        assert_eq!(Prediction::none(2).deviation(0, 1, 5.0), 1.0);
    }
}
