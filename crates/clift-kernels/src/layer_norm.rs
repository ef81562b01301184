//! Layer normalization of rows and its gradient.
// N rows, D columns

use rayon::prelude::*;

use crate::primitives::partition::{add, rows_per_sum, rows_per_task};
use crate::simd::dispatch::{InstructionSet, Kernel};
use crate::simd::vector::Simd;

/// Computes `output = (x - mean) / sqrt(variance + epsilon) * gamma + beta` per row. `statistics` receives the mean and
/// `1 / sqrt(variance + epsilon)` of every row, an input of [`layer_norm_backward`].
pub fn layer_norm_forward(
    set: InstructionSet,
    epsilon: f32,
    [x, gamma, beta]: [&[f32]; 3],
    output: &mut [f32],
    statistics: &mut [[f32; 2]],
) {
    let dim = gamma.len();
    assert!(dim > 0 && beta.len() == dim && x.len() == statistics.len() * dim && output.len() == x.len());
    let rows = rows_per_task(dim);
    let pieces = x.par_chunks(rows * dim).zip(output.par_chunks_mut(rows * dim)).zip(statistics.par_chunks_mut(rows));
    pieces.for_each(|((x, output), statistics)| {
        set.run(Forward { epsilon, x, gamma, beta, output, statistics });
    });
}

/// Computes the gradients of `x`, `gamma` and `beta` from the gradient of the output.
///
/// With `y = (x - mean) r` and `g = grad * gamma`: `dx = r (g - mean(g) - y mean(g y))`,
/// `dgamma = sum(grad * y)` and `dbeta = sum(grad)` over rows.
pub fn layer_norm_backward(
    set: InstructionSet,
    [x, gamma, grad]: [&[f32]; 3],
    statistics: &[[f32; 2]],
    [grad_x, grad_gamma, grad_beta]: [&mut [f32]; 3],
) {
    let dim = gamma.len();
    assert!(dim > 0 && grad_gamma.len() == dim && grad_beta.len() == dim && x.len() == statistics.len() * dim);
    assert!(grad.len() == x.len() && grad_x.len() == x.len());
    let rows = rows_per_sum(statistics.len(), dim);
    let parts = statistics.len().div_ceil(rows);
    let mut sums = vec![0.0; 2 * parts * dim];
    let pieces = x
        .par_chunks(rows * dim)
        .zip(grad.par_chunks(rows * dim))
        .zip(grad_x.par_chunks_mut(rows * dim))
        .zip(statistics.par_chunks(rows))
        .zip(sums.par_chunks_mut(2 * dim));
    pieces.for_each(|((((x, grad), grad_x), statistics), sums)| {
        set.run(Backward { x, gamma, grad, grad_x, statistics, sums });
    });
    grad_gamma.fill(0.0);
    grad_beta.fill(0.0);
    for sums in sums.chunks_exact(2 * dim) {
        let (gamma, beta) = sums.split_at(dim);
        add(gamma, grad_gamma);
        add(beta, grad_beta);
    }
}

struct Forward<'a> {
    epsilon: f32,
    x: &'a [f32],
    gamma: &'a [f32],
    beta: &'a [f32],
    output: &'a mut [f32],
    statistics: &'a mut [[f32; 2]],
}

impl Kernel for Forward<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { epsilon, x, gamma, beta, output, statistics } = self;
        let dim = gamma.len();
        let rows = x.chunks_exact(dim).zip(output.chunks_exact_mut(dim)).zip(statistics);
        for ((x, output), statistics) in rows {
            let mean = sum(simd, x) / dim as f32;
            let variance = sum_of_squares(simd, x, mean) / dim as f32;
            let inverse = 1.0 / (variance + epsilon).sqrt();
            *statistics = [mean, inverse];
            let (mean, inverse) = (simd.splat(mean), simd.splat(inverse));
            for start in (0..dim).step_by(S::LANES) {
                let normal = simd.mul(simd.sub(simd.read(&x[start..]), mean), inverse);
                let value = simd.mul_add(normal, simd.read(&gamma[start..]), simd.read(&beta[start..]));
                simd.write(&mut output[start..], value);
            }
        }
    }
}

struct Backward<'a> {
    x: &'a [f32],
    gamma: &'a [f32],
    grad: &'a [f32],
    grad_x: &'a mut [f32],
    statistics: &'a [[f32; 2]],
    /// Sums of the gradients of gamma, then of beta.
    sums: &'a mut [f32],
}

impl Kernel for Backward<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { x, gamma, grad, grad_x, statistics, sums } = self;
        let dim = gamma.len();
        let (sum_gamma, sum_beta) = sums.split_at_mut(dim);
        let rows = x.chunks_exact(dim).zip(grad.chunks_exact(dim)).zip(grad_x.chunks_exact_mut(dim)).zip(statistics);
        for (((x, grad), grad_x), &[mean, inverse]) in rows {
            let (mean, inverse) = (simd.splat(mean), simd.splat(inverse));
            let mut total = simd.splat(0.0);
            let mut total_normal = simd.splat(0.0);
            for start in (0..dim).step_by(S::LANES) {
                let grad = simd.read(&grad[start..]);
                // Beyond the last column gamma and grad are read as zeros.
                let normal = simd.mul(simd.sub(simd.read(&x[start..]), mean), inverse);
                let product = simd.mul(grad, normal);
                let gamma = simd.read(&gamma[start..]);
                total = simd.mul_add(grad, gamma, total);
                total_normal = simd.mul_add(product, gamma, total_normal);
                let sum = simd.add(simd.read(&sum_gamma[start..]), product);
                simd.write(&mut sum_gamma[start..], sum);
                let sum = simd.add(simd.read(&sum_beta[start..]), grad);
                simd.write(&mut sum_beta[start..], sum);
            }
            let share = -1.0 / dim as f32;
            let total = simd.splat(simd.sum(total) * share);
            let total_normal = simd.splat(simd.sum(total_normal) * share);
            for start in (0..dim).step_by(S::LANES) {
                let normal = simd.mul(simd.sub(simd.read(&x[start..]), mean), inverse);
                let slope = simd.mul_add(simd.read(&grad[start..]), simd.read(&gamma[start..]), total);
                let value = simd.mul(simd.mul_add(normal, total_normal, slope), inverse);
                simd.write(&mut grad_x[start..], value);
            }
        }
    }
}

#[inline(always)]
fn sum<S: Simd>(simd: S, values: &[f32]) -> f32 {
    let mut total = simd.splat(0.0);
    for chunk in values.chunks(S::LANES) {
        total = simd.add(total, simd.read(chunk));
    }
    simd.sum(total)
}

#[inline(always)]
fn sum_of_squares<S: Simd>(simd: S, values: &[f32], mean: f32) -> f32 {
    let full = values.len() / S::LANES * S::LANES;
    let shift = simd.splat(mean);
    let mut total = simd.splat(0.0);
    for chunk in values[..full].chunks(S::LANES) {
        let difference = simd.sub(simd.read(chunk), shift);
        total = simd.mul_add(difference, difference, total);
    }
    values[full..].iter().fold(simd.sum(total), |total, value| total + (value - mean).powi(2))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{assert_close, random};

    fn check(rows: usize, dim: usize, offset: f32) {
        let x: Vec<f32> = random(rows * dim, 1).iter().map(|value| value + offset).collect();
        let (gamma, beta, grad) = (random(dim, 2), random(dim, 3), random(rows * dim, 4));
        let epsilon = 1e-5;
        let mut expected = [rows * dim, rows * dim, dim, dim].map(|len| vec![0.0_f64; len]);
        let [output, grad_x, grad_gamma, grad_beta] = &mut expected;
        let mean_of = |values: &[f64]| values.iter().sum::<f64>() / dim as f64;
        for row in 0..rows {
            let wide = |values: &[f32]| values[row * dim..][..dim].iter().map(|&v| f64::from(v)).collect::<Vec<_>>();
            let (x, grad) = (wide(&x), wide(&grad));
            let mean = mean_of(&x);
            let variance = mean_of(&x.iter().map(|value| (value - mean).powi(2)).collect::<Vec<_>>());
            let inverse = 1.0 / (variance + epsilon).sqrt();
            let normal: Vec<f64> = x.iter().map(|value| (value - mean) * inverse).collect();
            let slope: Vec<f64> = grad.iter().zip(&gamma).map(|(grad, &gamma)| grad * f64::from(gamma)).collect();
            let along = mean_of(&slope.iter().zip(&normal).map(|(slope, normal)| slope * normal).collect::<Vec<_>>());
            for i in 0..dim {
                output[row * dim + i] = normal[i] * f64::from(gamma[i]) + f64::from(beta[i]);
                grad_x[row * dim + i] = inverse * (slope[i] - mean_of(&slope) - normal[i] * along);
                grad_gamma[i] += grad[i] * normal[i];
                grad_beta[i] += grad[i];
            }
        }
        for set in InstructionSet::available() {
            let mut output = vec![f32::NAN; rows * dim];
            let mut statistics = vec![[f32::NAN; 2]; rows];
            layer_norm_forward(set, epsilon as f32, [&x, &gamma, &beta], &mut output, &mut statistics);
            assert_close(&output, &expected[0], 1e-5);
            let mut grads = [rows * dim, dim, dim].map(|len| vec![f32::NAN; len]);
            let [grad_x, grad_gamma, grad_beta] = &mut grads;
            layer_norm_backward(set, [&x, &gamma, &grad], &statistics, [grad_x, grad_gamma, grad_beta]);
            for (got, expected) in grads.iter().zip(&expected[1..]) {
                assert_close(got, expected, 1e-5);
            }
        }
    }

    #[test]
    fn every_instruction_set_equals_f64_at_odd_shapes() {
        check(1, 5, 0.0);
        check(3, 12, 0.0);
        check(777, 37, 0.0);
        check(500, 96, 3.0);
        check(65, 768, -1.0);
    }
}
