//! RMS norms of the heads of queries and keys, and their gradients.
// N tokens, P parts of a row, K parts with a norm, H heads, E width of a head

use rayon::prelude::*;

use crate::primitives::partition::{add, rows_per_sum, rows_per_task};
use crate::simd::dispatch::{InstructionSet, Kernel};
use crate::simd::vector::{Operands, Simd};

/// Sizes of rows of heads: queries, keys and values side by side, or fewer of them.
#[derive(Clone, Copy, Debug)]
pub struct HeadRows {
    /// Parts of a row.
    pub num_parts: usize,
    /// Heads of a part.
    pub num_heads: usize,
    /// Values of a head.
    pub head_width: usize,
    /// Added to the mean square.
    pub epsilon: f64,
}

impl HeadRows {
    const fn len(&self) -> usize {
        self.num_parts * self.num_heads * self.head_width
    }
}

/// Computes `x / sqrt(mean(x^2) + epsilon) * gamma` of every head of the first K parts in place; the other parts stay.
///
/// # Shapes
/// - `gammas`: `[K, head_width]`
/// - `x`: `[N, num_parts, num_heads, head_width]`
pub fn rms_norm_forward(set: InstructionSet, rows: HeadRows, gammas: &[f32], x: &mut [f32]) {
    check(&rows, gammas, x);
    x.par_chunks_mut(rows_per_task(rows.len()) * rows.len()).for_each(|x| set.run(Forward { rows, gammas, x }));
}

/// Computes the gradients of `x`, in place of the gradient of the output, and adds those of `gammas` to `grad_gammas`.
///
/// With `y = x r`, `r = 1 / sqrt(mean(x^2) + epsilon)` and `g = grad gamma`: `dx = r (g - y mean(g y))`, and
/// `dgamma = sum(grad y)` over tokens and heads.
pub fn rms_norm_backward(
    set: InstructionSet,
    rows: HeadRows,
    [x, gammas]: [&[f32]; 2],
    grad: &mut [f32],
    grad_gammas: &mut [f32],
) {
    check(&rows, gammas, x);
    assert!(grad.len() == x.len() && grad_gammas.len() == gammas.len(), "a gradient per value");
    let count = rows_per_sum(x.len() / rows.len(), rows.len()) * rows.len();
    let mut sums = vec![0.0; x.len().div_ceil(count) * gammas.len()];
    let pieces = x.par_chunks(count).zip(grad.par_chunks_mut(count)).zip(sums.par_chunks_mut(gammas.len()));
    pieces.for_each(|((x, grad), sums)| set.run(Backward { rows, x, gammas, grad, sums }));
    sums.chunks_exact(gammas.len()).for_each(|sums| add(sums, grad_gammas));
}

fn check(rows: &HeadRows, gammas: &[f32], x: &[f32]) {
    let width = rows.head_width;
    assert!(rows.len() > 0 && x.len().is_multiple_of(rows.len()), "whole rows");
    assert!(!gammas.is_empty() && gammas.len().is_multiple_of(width), "whole gammas");
    assert!(gammas.len() / width <= rows.num_parts, "at most a gamma per part");
}

struct Forward<'a> {
    rows: HeadRows,
    gammas: &'a [f32],
    x: &'a mut [f32],
}

impl Kernel for Forward<'_> {
    #[inline(always)]
    fn run<S: Simd, O: Operands>(self, simd: S) {
        let Self { rows, gammas, x } = self;
        let width = rows.head_width;
        for row in x.chunks_exact_mut(rows.len()) {
            for (part, gamma) in row.chunks_exact_mut(rows.num_heads * width).zip(gammas.chunks_exact(width)) {
                for head in part.chunks_exact_mut(width) {
                    let scale = simd.splat(inverse_rms(simd, head, rows.epsilon as f32));
                    for start in (0..width).step_by(S::LANES) {
                        let value = simd.mul(simd.mul(simd.read(&head[start..]), scale), simd.read(&gamma[start..]));
                        simd.write(&mut head[start..], value);
                    }
                }
            }
        }
    }
}

struct Backward<'a> {
    rows: HeadRows,
    x: &'a [f32],
    gammas: &'a [f32],
    grad: &'a mut [f32],
    /// Sums of the gradients of the gammas.
    sums: &'a mut [f32],
}

impl Kernel for Backward<'_> {
    #[inline(always)]
    fn run<S: Simd, O: Operands>(self, simd: S) {
        let Self { rows, x, gammas, grad, sums } = self;
        let (width, part_len) = (rows.head_width, rows.num_heads * rows.head_width);
        for (x, grad) in x.chunks_exact(rows.len()).zip(grad.chunks_exact_mut(rows.len())) {
            let parts = x.chunks_exact(part_len).zip(grad.chunks_exact_mut(part_len));
            let gammas = gammas.chunks_exact(width).zip(sums.chunks_exact_mut(width));
            for ((x, grad), (gamma, sum)) in parts.zip(gammas) {
                for (x, grad) in x.chunks_exact(width).zip(grad.chunks_exact_mut(width)) {
                    let inverse = inverse_rms(simd, x, rows.epsilon as f32);
                    let scale = simd.splat(inverse);
                    let mut along = simd.splat(0.0);
                    for start in (0..width).step_by(S::LANES) {
                        let product = simd.mul(simd.read(&grad[start..]), simd.mul(simd.read(&x[start..]), scale));
                        along = simd.mul_add(product, simd.read(&gamma[start..]), along);
                        let total = simd.add(simd.read(&sum[start..]), product);
                        simd.write(&mut sum[start..], total);
                    }
                    let along = simd.splat(-simd.sum(along) * inverse / width as f32);
                    for start in (0..width).step_by(S::LANES) {
                        let slope = simd.mul(simd.read(&grad[start..]), simd.read(&gamma[start..]));
                        let value = simd.mul(simd.mul_add(simd.read(&x[start..]), along, slope), scale);
                        simd.write(&mut grad[start..], value);
                    }
                }
            }
        }
    }
}

/// Returns `1 / sqrt(mean(x^2) + epsilon)`.
#[inline(always)]
fn inverse_rms<S: Simd>(simd: S, x: &[f32], epsilon: f32) -> f32 {
    let mut total = simd.splat(0.0);
    for chunk in x.chunks(S::LANES) {
        let value = simd.read(chunk);
        total = simd.mul_add(value, value, total);
    }
    1.0 / (simd.sum(total) / x.len() as f32 + epsilon).sqrt()
}
