//! Blockwise attention, backward.

use std::ops::Range;

use rayon::prelude::*;

use crate::attention::shapes::{
    AttentionGradients, AttentionSizes, HeadBlocks, QUERY_BLOCK, ROW_PADDING, StridedRows, copy_padded, copy_transposed,
};
use crate::primitives::matmul::{Left, Right, multiply, padded, panel_width};
use crate::primitives::scratch::Scratch;
use crate::primitives::shared_slice::SharedSlice;
use crate::simd::dispatch::{InstructionSet, Kernel};
use crate::simd::vector::Simd;

/// Keys per block: a task holds a block of scores and one of their gradients.
const BACKWARD_KEYS: usize = 256;

/// Inputs of [`attention_backward`]: inputs and results of [`attention_forward`](crate::attention_forward), and the
/// gradient of the output.
#[derive(Clone, Copy, Debug)]
pub struct BackwardInputs<'a> {
    /// Queries.
    pub query: StridedRows<'a>,
    /// Keys.
    pub key: StridedRows<'a>,
    /// Values.
    pub value: StridedRows<'a>,
    /// Output of the forward pass.
    pub output: StridedRows<'a>,
    /// Log sums of the forward pass, `[batch, num_heads, num_queries]`.
    pub log_sum: &'a [f32],
    /// Gradient of the output.
    pub grad_output: StridedRows<'a>,
}

/// Computes the gradients of queries, keys and values.
///
/// With `P = softmax(s q k^T)`: `dV = P^T dO`, `dS = P * (dO V^T - rowsum(dO * O))`, `dQ = s dS K`,
/// `dK = s dS^T Q`. The scores are computed again, a block at a time.
pub fn attention_backward(
    set: InstructionSet,
    sizes: AttentionSizes,
    inputs: BackwardInputs<'_>,
    gradients: AttentionGradients<'_>,
) {
    let AttentionSizes { batch, num_queries, num_keys, num_heads, .. } = sizes;
    let dim = sizes.dim();
    assert_eq!(inputs.log_sum.len(), batch * num_heads * num_queries, "one log sum per row of scores");
    match gradients {
        AttentionGradients::Packed(packed) => {
            assert!(packed.len() == batch * num_queries * 3 * dim && num_keys == num_queries);
            let packed = SharedSlice::new(packed);
            let part = |part| HeadBlocks { values: &packed, count: num_queries, width: 3 * dim, first: part * dim };
            backward_into(set, sizes, inputs, [part(0), part(1), part(2)]);
        }
        AttentionGradients::Separate { query, key_value } => {
            assert!(query.len() == batch * num_queries * dim && key_value.len() == batch * num_keys * 2 * dim);
            let (query, key_value) = (SharedSlice::new(query), SharedSlice::new(key_value));
            let part = |part| HeadBlocks { values: &key_value, count: num_keys, width: 2 * dim, first: part * dim };
            let query = HeadBlocks { values: &query, count: num_queries, width: dim, first: 0 };
            backward_into(set, sizes, inputs, [query, part(0), part(1)]);
        }
    }
}

/// Writes the gradients to three parts, which must not overlap.
fn backward_into(
    set: InstructionSet,
    sizes: AttentionSizes,
    inputs: BackwardInputs<'_>,
    [grad_query, grad_key, grad_value]: [HeadBlocks<'_>; 3],
) {
    let AttentionSizes { num_queries, num_keys, num_heads, head_width, .. } = sizes;
    let blocks = num_keys.div_ceil(BACKWARD_KEYS);
    let parts = sizes.parts(blocks);
    // Every part of the keys contributes to the gradients of all queries.
    let partial: Vec<Vec<f32>> = (0..sizes.batch * num_heads * parts)
        .into_par_iter()
        .map(|task| {
            let (head, part) = (task / parts, task % parts);
            let bound = |part: usize| (part * blocks / parts * BACKWARD_KEYS).min(num_keys);
            set.run(BackwardTask {
                sizes,
                inputs,
                grad_key,
                grad_value,
                scene: head / num_heads,
                head: head % num_heads,
                keys: bound(part)..bound(part + 1),
            })
        })
        .collect();
    (0..sizes.batch * num_heads).into_par_iter().for_each(|head| {
        let parts = &partial[head * parts..(head + 1) * parts];
        for row in 0..num_queries {
            let width = parts[0].len() / num_queries;
            let values = (row * width..row * width + head_width)
                .map(|i| parts.iter().map(|part| part[i]).sum::<f32>() * sizes.scale());
            // SAFETY: no other task has this head.
            unsafe { grad_query.write([head / num_heads, row, head % num_heads], values) };
        }
    });
}

struct BackwardTask<'a> {
    sizes: AttentionSizes,
    inputs: BackwardInputs<'a>,
    grad_key: HeadBlocks<'a>,
    grad_value: HeadBlocks<'a>,
    scene: usize,
    head: usize,
    keys: Range<usize>,
}

impl<'a> Kernel for BackwardTask<'a> {
    /// Unscaled gradients of all queries from the task's keys, in rows of the padded head width.
    type Output = Vec<f32>;
    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> Vec<f32> {
        let Self { sizes, inputs, grad_key, grad_value, scene, head, keys } = self;
        let AttentionSizes { num_queries, num_keys, num_heads, head_width, .. } = sizes;
        let (width, panel) = (padded::<S>(head_width), panel_width::<S>());
        let block = num_keys.min(BACKWARD_KEYS);
        let score_row = block.next_multiple_of(panel) + ROW_PADDING;
        let lens = [
            num_queries * width,
            num_queries * width,
            num_queries,
            block.next_multiple_of(panel) * head_width,
            block.next_multiple_of(panel) * head_width,
            block * width,
            block * width,
            block * width,
            QUERY_BLOCK * score_row,
            QUERY_BLOCK * score_row,
        ];
        let mut grad_query = vec![0.0; num_queries * width];
        let head_of = |rows: &StridedRows<'a>, row: usize| rows.head(&sizes, scene, row, head);
        let mut scratch = Scratch::take(lens.iter().sum());
        let [queries, grads, delta, keys_t, values_t, key_rows, key_sums, value_sums, weights, slopes] =
            scratch.cut(lens);
        copy_padded(queries, width, (0..num_queries).map(|row| head_of(&inputs.query, row)));
        copy_padded(grads, width, (0..num_queries).map(|row| head_of(&inputs.grad_output, row)));
        for (row, to) in delta.iter_mut().enumerate() {
            let pairs = head_of(&inputs.output, row).iter().zip(head_of(&inputs.grad_output, row));
            *to = pairs.map(|(a, b)| a * b).sum();
        }
        let log_sum = &inputs.log_sum[(scene * num_heads + head) * num_queries..][..num_queries];
        for first_key in keys.clone().step_by(BACKWARD_KEYS) {
            let count = BACKWARD_KEYS.min(keys.end - first_key);
            let rows = first_key..first_key + count;
            copy_transposed(keys_t, panel, head_width, rows.clone().map(|row| head_of(&inputs.key, row)));
            copy_transposed(values_t, panel, head_width, rows.clone().map(|row| head_of(&inputs.value, row)));
            copy_padded(key_rows, width, rows.clone().map(|row| head_of(&inputs.key, row)));
            key_sums.fill(0.0);
            value_sums.fill(0.0);
            for start in (0..num_queries).step_by(QUERY_BLOCK) {
                let rows = QUERY_BLOCK.min(num_queries - start);
                let (query, grad) = (&queries[start * width..], &grads[start * width..]);
                let transposed = |values| Right { values, step: panel, panel: panel * head_width };
                let by_row = |values| Left { values, row: width, step: 1 };
                let size = [rows, head_width, count];
                multiply(simd, size, by_row(query), transposed(keys_t), (weights, score_row), false);
                multiply(simd, size, by_row(grad), transposed(values_t), (slopes, score_row), false);
                for row in 0..rows {
                    let range = row * score_row..row * score_row + padded::<S>(count);
                    score_gradients(
                        simd,
                        (&mut weights[range.clone()], &mut slopes[range]),
                        sizes.scale() * std::f32::consts::LOG2_E,
                        log_sum[start + row],
                        delta[start + row],
                    );
                }
                let by_key = |values| Left { values, row: 1, step: score_row };
                let plain = |values| Right { values, step: width, panel };
                let size = [count, rows, head_width];
                multiply(simd, size, by_key(weights), plain(grad), (value_sums, width), true);
                multiply(simd, size, by_key(slopes), plain(query), (key_sums, width), true);
                let by_query = Left { values: slopes, row: score_row, step: 1 };
                let to = (&mut grad_query[start * width..], width);
                multiply(simd, [rows, count, head_width], by_query, plain(key_rows), to, true);
            }
            for row in 0..count {
                let index = [scene, first_key + row, head];
                let key_row = key_sums[row * width..][..head_width].iter().map(|sum| sum * sizes.scale());
                let value_row = value_sums[row * width..][..head_width].iter().copied();
                // SAFETY: no other task has this key of this head.
                unsafe {
                    grad_key.write(index, key_row);
                    grad_value.write(index, value_row);
                }
            }
        }
        grad_query
    }
}

/// Replaces a row of scores by the weights `P`, and the row of the weights' gradients by the scores' gradients.
#[inline(always)]
fn score_gradients<S: Simd>(simd: S, (scores, slopes): (&mut [f32], &mut [f32]), scale: f32, log_sum: f32, delta: f32) {
    let (factor, shift, delta) = (simd.splat(scale), simd.splat(-log_sum), simd.splat(delta));
    for (score, slope) in scores.chunks_exact_mut(S::LANES).zip(slopes.chunks_exact_mut(S::LANES)) {
        let weight = simd.exp2(simd.mul_add(simd.read(score), factor, shift));
        simd.write(score, weight);
        simd.write(slope, simd.mul(weight, simd.sub(simd.read(slope), delta)));
    }
}

#[cfg(test)]
mod tests;
