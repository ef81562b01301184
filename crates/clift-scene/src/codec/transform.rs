//! Karhunen-Loeve transform of tokens: mean and orthogonal directions by descending variance. A direction that renderings
//! depend on less is longer, so that one step for all coefficients is coarser along it.
// S tokens, D width

use burn::linalg::svd;
use burn::tensor::{DType, Device, Tensor, TensorData};
use clift_kernels::linear_forward;

/// Smallest deviation of a direction as a share of the largest. Directions without variance need one, too.
const MIN_DEVIATION: f64 = 1e-6;
/// Most sweeps of the decomposition per direction; it converges in two or three.
const SVD_SWEEPS: usize = 100;

/// Sums of tokens and of their products, weighted by scene, in 64-bit floats on the host.
#[derive(Clone, Debug)]
pub struct Moments {
    num_scenes: f64,
    /// `[1, D]`
    sum: Tensor<2>,
    /// `[D, D]`
    products: Tensor<2>,
}

impl Moments {
    pub fn new(dim: usize) -> Self {
        let zeros = |rows| Tensor::zeros([rows, dim], (&Device::flex(), DType::F64));
        Self { num_scenes: 0.0, sum: zeros(1), products: zeros(dim) }
    }

    /// Adds the tokens of a scene, `[S, D]`. Every scene has the same weight.
    pub fn add(&mut self, tokens: &[f32]) {
        let [_, dim] = self.sum.dims();
        let count = tokens.len() / dim;
        let values: Vec<f64> = tokens.iter().map(|&value| f64::from(value)).collect();
        let tokens = Tensor::<2>::from_data(TensorData::new(values, [count, dim]), (&Device::flex(), DType::F64));
        self.num_scenes += 1.0;
        self.sum = self.sum.clone() + tokens.clone().mean_dim(0);
        self.products = self.products.clone() + tokens.clone().transpose().matmul(tokens) / count as f64;
    }

    pub fn transform(&self) -> Transform {
        let [_, dim] = self.sum.dims();
        let mean = self.sum.clone() / self.num_scenes;
        let covariance = self.products.clone() / self.num_scenes - mean.clone().transpose().matmul(mean.clone());
        // Of a symmetric positive matrix, singular vectors and values are eigenvectors and eigenvalues.
        let (directions, variances, _) = svd::<2, 1>(covariance, SVD_SWEEPS);
        let [mean, directions, variances] = [mean.flatten::<1>(0, 1), directions.transpose().flatten(0, 1), variances]
            .map(|tensor| tensor.into_data().try_to_vec::<f64>().expect("f64 on the host"));
        let largest = variances[0].sqrt();
        let deviation = |variance: &f64| variance.sqrt().max(largest * MIN_DEVIATION).max(f64::from(f32::MIN_POSITIVE));
        // An eigenvector has no sign: its largest entry is made positive.
        let largest_of = |row: &[f64]| row.iter().fold(0.0_f64, |most, &x| if x.abs() > most.abs() { x } else { most });
        let with_sign = |row: &[f64]| {
            let sign = largest_of(row).signum();
            row.iter().map(|value| (value * sign) as f32).collect::<Vec<f32>>()
        };
        Transform {
            mean: mean.iter().map(|&value| value as f32).collect(),
            deviations: variances.iter().map(|variance| deviation(variance) as f32).collect(),
            basis: directions.chunks_exact(dim).flat_map(with_sign).collect(),
        }
    }
}

#[derive(Clone, Debug, PartialEq)]
pub struct Transform {
    /// `[D]`
    pub mean: Vec<f32>,
    /// Orthogonal directions, `[D, D]`, a row each.
    pub basis: Vec<f32>,
    /// Standard deviation of the coefficient of every direction, positive, `[D]`.
    pub deviations: Vec<f32>,
}

impl Transform {
    pub fn direction(&self, index: usize) -> &[f32] {
        let dim = self.mean.len();
        &self.basis[index * dim..(index + 1) * dim]
    }

    /// Multiplies the coefficients of every direction by a positive weight, and divides the direction by the weight.
    pub fn weigh(&mut self, weights: &[f32]) {
        let dim = self.mean.len();
        for ((row, deviation), weight) in self.basis.chunks_exact_mut(dim).zip(&mut self.deviations).zip(weights) {
            for value in row {
                *value /= weight;
            }
            *deviation *= weight;
        }
    }

    /// Returns the coefficients of tokens along the directions, `[S, D]`.
    pub fn forward(&self, tokens: &[f32]) -> Vec<f32> {
        let dim = self.mean.len();
        let squares: Vec<f32> =
            self.basis.chunks_exact(dim).map(|row| row.iter().map(|value| value * value).sum()).collect();
        let centered: Vec<f32> =
            tokens.chunks_exact(dim).flat_map(|token| token.iter().zip(&self.mean).map(|(x, mean)| x - mean)).collect();
        let columns: Vec<f32> =
            (0..dim * dim).map(|i| self.basis[i % dim * dim + i / dim] / squares[i % dim]).collect();
        let mut coefficients = vec![0.0; tokens.len()];
        linear_forward([tokens.len() / dim, dim, dim], [&centered, &columns, &vec![0.0; dim]], &mut coefficients);
        coefficients
    }

    /// Returns the tokens `[S, D]` of `levels` times `step`, where `levels[d]` has a level per token, or none for zeros.
    pub fn inverse(&self, levels: &[Vec<i32>], step: f32, num_tokens: usize) -> Vec<f32> {
        let dim = self.mean.len();
        let used: Vec<usize> = (0..dim).filter(|&d| levels[d].iter().any(|&level| level != 0)).collect();
        let mut coefficients = vec![0.0; num_tokens * used.len()];
        for (column, &d) in used.iter().enumerate() {
            for (row, &level) in levels[d].iter().enumerate() {
                coefficients[row * used.len() + column] = level as f32 * step;
            }
        }
        let basis: Vec<f32> = used.iter().flat_map(|&d| &self.basis[d * dim..(d + 1) * dim]).copied().collect();
        let mut tokens = vec![0.0; num_tokens * dim];
        linear_forward([num_tokens, used.len(), dim], [&coefficients, &basis, &self.mean], &mut tokens);
        tokens
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Tokens of width 3 that vary by 5 along (3, 4, 0) / 5, and by 1 along the last axis.
    fn tokens() -> Vec<f32> {
        [[1.0, 0.5], [-1.0, 0.5], [1.0, -0.5], [-1.0, -0.5]]
            .iter()
            .flat_map(|[a, b]| [10.0 + 3.0 * a, 4.0 * a, 2.0 * b - 7.0])
            .collect()
    }

    #[test]
    fn directions_are_those_of_the_variance() {
        let mut moments = Moments::new(3);
        moments.add(&tokens());
        moments.add(&tokens()[..6]); // a scene of two tokens has the weight of one of four
        moments.add(&tokens()[6..]);
        let found = moments.transform();
        let near = |got: &[f32], expected: &[f32]| got.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-5);
        assert!(near(&found.mean, &[10.0, 0.0, -7.0]), "{found:?}");
        assert!(near(&found.basis[..6], &[0.6, 0.8, 0.0, 0.0, 0.0, 1.0]), "{found:?}");
        assert!(near(&found.deviations[..2], &[5.0, 1.0]) && found.deviations[2] > 0.0, "{found:?}");
    }

    #[test]
    fn tokens_come_back_from_their_coefficients_whatever_the_weights() {
        let mut moments = Moments::new(3);
        moments.add(&tokens());
        let plain = moments.transform();
        let mut weighed = plain.clone();
        weighed.weigh(&[2.0, 1.0, 0.25]);
        assert_eq!(weighed.deviations[0], 2.0 * plain.deviations[0]);
        let (before, after) = (plain.forward(&tokens()), weighed.forward(&tokens()));
        assert!(before.chunks(3).zip(after.chunks(3)).all(|(a, b)| (2.0 * a[0] - b[0]).abs() < 1e-5), "{after:?}");
        for (transform, coefficients) in [(&plain, before), (&weighed, after)] {
            let level = |d: usize, row: usize| (coefficients[row * 3 + d] * 1e4).round() as i32;
            let levels: Vec<Vec<i32>> = (0..3).map(|d| (0..4).map(|row| level(d, row)).collect()).collect();
            for (got, expected) in transform.inverse(&levels, 1e-4, 4).iter().zip(tokens()) {
                assert!((got - expected).abs() < 1e-3, "{got} against {expected}");
            }
        }
        assert_eq!(plain.inverse(&[vec![], vec![], vec![]], 1.0, 2), [&plain.mean[..]; 2].concat());
    }

    #[test]
    fn constant_tokens_have_a_transform() {
        let mut moments = Moments::new(2);
        moments.add(&[3.0; 8]);
        let transform = moments.transform();
        assert!(transform.deviations.iter().all(|deviation| *deviation > 0.0 && deviation.is_finite()));
        assert!(transform.basis.iter().all(|value| value.is_finite()));
    }
}
