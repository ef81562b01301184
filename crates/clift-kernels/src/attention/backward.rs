//! Blockwise attention, backward.

use std::ops::Range;

use rayon::prelude::*;

use crate::attention::shapes::{AttentionSizes, HeadBlocks, QUERY_BLOCK, ROW_PADDING, StridedRows};
use crate::primitives::matmul::{Left, Right, multiply, padded, panel_width};
use crate::primitives::packing::{lanes_of, pack_across, pack_in_place, pack_panels, pack_rows, pack_transposed};
use crate::primitives::scratch::Scratch;
use crate::primitives::shared_slice::SharedSlice;
use crate::simd::dispatch::{InstructionSet, Kernel, OperandType};
use crate::simd::vector::{Operands, Simd, dot};

/// Keys per block: a task holds a block of scores and one of their gradients.
const BACKWARD_KEYS: usize = 256;

/// Computes the gradients of queries, keys and values: `[batch, num_queries, 3 dim]` side by side in one slice, or those of
/// the queries in one and those of keys and values, `[batch, num_keys, 2 dim]`, in another. `inputs` are queries, keys, values,
/// output and gradient of the output; `log_sum` is that of [`attention_forward`](crate::attention_forward).
///
/// With `P = softmax(s q k^T)`: `dV = P^T dO`, `dS = P * (dO V^T - rowsum(dO * O))`, `dQ = s dS K`,
/// `dK = s dS^T Q`. The scores are computed again, a block at a time. Operands of the products have the type `operands`,
/// that of the forward pass.
pub fn attention_backward(
    set: InstructionSet,
    operands: OperandType,
    sizes: AttentionSizes,
    inputs: [StridedRows<'_>; 5],
    log_sum: &[f32],
    gradients: &mut [&mut [f32]],
) {
    let AttentionSizes { batch, num_queries, num_keys, num_heads, .. } = sizes;
    let dim = sizes.dim();
    assert_eq!(log_sum.len(), batch * num_heads * num_queries, "one log sum per row of scores");
    match gradients {
        [packed] => {
            assert!(packed.len() == batch * num_queries * 3 * dim && num_keys == num_queries);
            let packed = SharedSlice::new(packed);
            let part = |part| HeadBlocks { values: &packed, count: num_queries, width: 3 * dim, first: part * dim };
            backward_into(set, operands, sizes, (inputs, log_sum), [part(0), part(1), part(2)]);
        }
        [query, key_value] => {
            assert!(query.len() == batch * num_queries * dim && key_value.len() == batch * num_keys * 2 * dim);
            let (query, key_value) = (SharedSlice::new(query), SharedSlice::new(key_value));
            let part = |part| HeadBlocks { values: &key_value, count: num_keys, width: 2 * dim, first: part * dim };
            let query = HeadBlocks { values: &query, count: num_queries, width: dim, first: 0 };
            backward_into(set, operands, sizes, (inputs, log_sum), [query, part(0), part(1)]);
        }
        _ => panic!("gradients are in one slice or in two"),
    }
}

/// Writes the gradients to three parts, which must not overlap.
fn backward_into(
    set: InstructionSet,
    operands: OperandType,
    sizes: AttentionSizes,
    (inputs, log_sum): ([StridedRows<'_>; 5], &[f32]),
    [grad_query, grad_key, grad_value]: [HeadBlocks<'_>; 3],
) {
    let AttentionSizes { num_queries, num_keys, num_heads, head_width, .. } = sizes;
    let blocks = num_keys.div_ceil(BACKWARD_KEYS);
    let parts = sizes.parts(blocks);
    // Every part of the keys contributes to the gradients of all queries.
    let mut partial: Vec<Vec<f32>> = (0..sizes.batch * num_heads * parts)
        .into_par_iter()
        .map(|task| {
            let (head, part) = (task / parts, task % parts);
            let bound = |part: usize| (part * blocks / parts * BACKWARD_KEYS).min(num_keys);
            let mut grad_query = Vec::new();
            let task = BackwardTask {
                sizes,
                inputs,
                log_sum,
                grad_query: &mut grad_query,
                grad_key,
                grad_value,
                scene: head / num_heads,
                head: head % num_heads,
                keys: bound(part)..bound(part + 1),
            };
            set.run_product(operands, task);
            grad_query
        })
        .collect();
    partial.par_chunks_mut(parts).enumerate().for_each(|(head, parts)| {
        let (sums, others) = parts.split_first_mut().expect("at least one part");
        for other in others {
            sums.iter_mut().zip(&*other).for_each(|(sum, value)| *sum += value);
        }
        for row in 0..num_queries {
            let sums = &sums[row * (sums.len() / num_queries)..][..head_width];
            let values = sums.iter().map(|sum| sum * sizes.scale());
            // SAFETY: no other task has this head.
            unsafe { grad_query.write([head / num_heads, row, head % num_heads], values) };
        }
    });
}

struct BackwardTask<'a> {
    sizes: AttentionSizes,
    inputs: [StridedRows<'a>; 5],
    log_sum: &'a [f32],
    /// Receives the unscaled gradients of all queries from the task's keys, in rows of the padded head width.
    grad_query: &'a mut Vec<f32>,
    grad_key: HeadBlocks<'a>,
    grad_value: HeadBlocks<'a>,
    scene: usize,
    head: usize,
    keys: Range<usize>,
}

impl<'a> Kernel for BackwardTask<'a> {
    #[inline(always)]
    fn run<S: Simd, O: Operands>(self, simd: S) {
        let Self { sizes, inputs, log_sum, grad_query, grad_key, grad_value, scene, head, keys } = self;
        let [query, key, value, output, grad_output] = inputs;
        let AttentionSizes { num_queries, num_keys, num_heads, head_width, .. } = sizes;
        let (width, panel, inner) = (padded::<S>(head_width), panel_width::<S>(), lanes_of::<S, O>(head_width));
        let block = num_keys.min(BACKWARD_KEYS);
        let key_lanes = lanes_of::<S, O>(block);
        let score_row = block.next_multiple_of(panel) + ROW_PADDING;
        // Values of f32 have the same layout along as across.
        let only_pairs = |len: usize| if O::PER_LANE > 1 { len } else { 0 };
        let lens = [
            only_pairs(num_queries * inner),
            only_pairs(num_queries * inner),
            lanes_of::<S, O>(num_queries) * width,
            lanes_of::<S, O>(num_queries) * width,
            num_queries,
            block.next_multiple_of(panel) * inner,
            block.next_multiple_of(panel) * inner,
            key_lanes * width.next_multiple_of(panel),
            block * width,
            block * width,
            QUERY_BLOCK * score_row,
            QUERY_BLOCK * score_row,
            only_pairs(lanes_of::<S, O>(QUERY_BLOCK) * score_row),
        ];
        grad_query.resize(num_queries * width, 0.0);
        let rows_of =
            |rows: StridedRows<'a>, range: Range<usize>| range.map(move |row| rows.head(&sizes, scene, row, head));
        let mut scratch = Scratch::take(lens.iter().sum());
        let [
            queries,
            grads,
            queries_across,
            grads_across,
            delta,
            keys_t,
            values_t,
            key_panels,
            key_sums,
            value_sums,
            weights,
            slopes,
            across,
        ] = scratch.cut(lens);
        pack_across::<S, O>(simd, rows_of(query, 0..num_queries), width, queries_across);
        pack_across::<S, O>(simd, rows_of(grad_output, 0..num_queries), width, grads_across);
        let (queries, grads, query_row) = if O::PER_LANE > 1 {
            pack_rows::<S, O>(simd, rows_of(query, 0..num_queries), inner, queries);
            pack_rows::<S, O>(simd, rows_of(grad_output, 0..num_queries), inner, grads);
            (&*queries, &*grads, inner)
        } else {
            (&*queries_across, &*grads_across, width)
        };
        let outputs = rows_of(output, 0..num_queries).zip(rows_of(grad_output, 0..num_queries));
        for (to, (output, grad)) in delta.iter_mut().zip(outputs) {
            *to = dot(simd, output, grad);
        }
        let log_sum = &log_sum[(scene * num_heads + head) * num_queries..][..num_queries];
        for first_key in keys.clone().step_by(BACKWARD_KEYS) {
            let count = BACKWARD_KEYS.min(keys.end - first_key);
            let rows = first_key..first_key + count;
            pack_transposed::<S, O>(simd, rows_of(key, rows.clone()), [inner, panel], keys_t);
            pack_transposed::<S, O>(simd, rows_of(value, rows.clone()), [inner, panel], values_t);
            pack_panels::<S, O>(simd, rows_of(key, rows), [key_lanes, panel], key_panels);
            key_sums.fill(0.0);
            value_sums.fill(0.0);
            for start in (0..num_queries).step_by(QUERY_BLOCK) {
                let rows = QUERY_BLOCK.min(num_queries - start);
                let first_lane = lanes_of::<S, O>(start) * width;
                let size = [rows, inner, count];
                let left = |values| Left { values, row: query_row, step: 1 };
                let right = |values| Right { values, step: panel, panel: panel * inner };
                let (query, grad) = (&queries[start * query_row..], &grads[start * query_row..]);
                multiply::<S, O>(simd, size, left(query), right(keys_t), (weights, score_row), false);
                multiply::<S, O>(simd, size, left(grad), right(values_t), (slopes, score_row), false);
                let of_rows = (&log_sum[start..start + rows], &delta[start..start + rows]);
                let (pair, size) = ((&mut *weights, &mut *slopes), [score_row, padded::<S>(count)]);
                score_gradients::<S, O>(simd, pair, size, sizes.exponent_scale(), of_rows);
                let size = [count, lanes_of::<S, O>(rows), head_width];
                let right = |values| Right { values, step: width, panel };
                let (query, grad) = (&queries_across[first_lane..], &grads_across[first_lane..]);
                let left = by_key::<S, O>(simd, weights, [rows, count, score_row], across);
                multiply::<S, O>(simd, size, left, right(grad), (value_sums, width), true);
                let left = by_key::<S, O>(simd, slopes, [rows, count, score_row], across);
                multiply::<S, O>(simd, size, left, right(query), (key_sums, width), true);
                for row in 0..rows {
                    pack_in_place::<S, O>(simd, &mut slopes[row * score_row..][..score_row], count);
                }
                let left = Left { values: slopes, row: score_row, step: 1 };
                let size = [rows, lanes_of::<S, O>(count), head_width];
                let to = (&mut grad_query[start * width..], width);
                let right = Right { values: key_panels, step: panel, panel: key_lanes * panel };
                multiply::<S, O>(simd, size, left, right, to, true);
            }
            for (row, (keys, values)) in key_sums.chunks(width).zip(value_sums.chunks(width)).take(count).enumerate() {
                let index = [scene, first_key + row, head];
                // SAFETY: no other task has this key of this head.
                unsafe {
                    grad_key.write(index, keys[..head_width].iter().map(|sum| sum * sizes.scale()));
                    grad_value.write(index, values[..head_width].iter().copied());
                }
            }
        }
    }
}

/// Returns `values[rows, count]`, in rows of `stride` values, as a transposed left factor; pairs are packed into `across`.
#[inline(always)]
fn by_key<'v, S: Simd, O: Operands>(
    simd: S,
    values: &'v [f32],
    [rows, count, stride]: [usize; 3],
    across: &'v mut [f32],
) -> Left<'v> {
    let values = if O::PER_LANE > 1 {
        let across = &mut across[..lanes_of::<S, O>(rows) * stride];
        let rows = values.chunks(stride).take(rows).map(|row| &row[..count]);
        pack_across::<S, O>(simd, rows, stride, across);
        across
    } else {
        values
    };
    Left { values, row: 1, step: stride }
}

/// Replaces rows of scores, whole vectors of `width` values every `stride`, by the weights `P`, and the weights' gradients by
/// the scores' gradients. `log_sums` and `deltas` have a value per row.
#[inline(always)]
fn score_gradients<S: Simd, O: Operands>(
    simd: S,
    (scores, slopes): (&mut [f32], &mut [f32]),
    [stride, width]: [usize; 2],
    scale: f32,
    (log_sums, deltas): (&[f32], &[f32]),
) {
    assert!(width.is_multiple_of(S::LANES), "whole vectors");
    let rows = scores.chunks_mut(stride).zip(slopes.chunks_mut(stride));
    for ((scores, slopes), (&log_sum, &delta)) in rows.zip(log_sums.iter().zip(deltas)) {
        let (factor, shift, delta) = (simd.splat(scale), simd.splat(-log_sum), simd.splat(delta));
        let (scores, slopes) = (scores[..width].as_mut_ptr(), slopes[..width].as_mut_ptr());
        for start in (0..width).step_by(S::LANES) {
            // SAFETY: `width` is a multiple of `LANES`. Slower by slices: their length is read in every iteration.
            unsafe {
                let (score, slope) = (scores.add(start), slopes.add(start));
                let weight = O::exp2(simd, simd.mul_add(simd.load(score), factor, shift));
                simd.store(score, weight);
                simd.store(slope, simd.mul(weight, simd.sub(simd.load(slope), delta)));
            }
        }
    }
}
