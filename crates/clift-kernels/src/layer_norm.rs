//! Layer normalization of rows and its gradient.
// N rows, D columns

use rayon::prelude::*;

use crate::primitives::partition::{add, rows_per_sum, rows_per_task};
use crate::simd::dispatch::{InstructionSet, Kernel};
use crate::simd::vector::{Operands, Simd};

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
    #[inline(always)]
    fn run<S: Simd, O: Operands>(self, simd: S) {
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
    #[inline(always)]
    fn run<S: Simd, O: Operands>(self, simd: S) {
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
