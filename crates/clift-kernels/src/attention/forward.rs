//! Blockwise attention, forward.

use std::ops::Range;

use rayon::prelude::*;

use crate::attention::shapes::{AttentionSizes, HeadBlocks, QUERY_BLOCK, ROW_PADDING, StridedRows};
use crate::primitives::matmul::{Left, Right, multiply, padded, panel_width};
use crate::primitives::packing::{lanes_of, pack_in_place, pack_panels, pack_rows, pack_transposed};
use crate::primitives::scratch::Scratch;
use crate::primitives::shared_slice::SharedSlice;
use crate::simd::dispatch::{InstructionSet, Kernel, OperandType};
use crate::simd::vector::{Operands, Simd};

/// Keys per block: the scores of a block take 200 KB.
const FORWARD_KEYS: usize = 512;

/// Computes `softmax(q k^T / sqrt(head width)) v` per head; operands of the products have the type `operands`.
///
/// # Shapes
/// - `output`: `[batch, num_queries, dim]`
/// - `log_sum`: `[batch, num_heads, num_queries]`, receives `log2(sum(2^(score * log2(e))))` of every row of scores,
///   an input of [`attention_backward`](crate::attention_backward)
pub fn attention_forward(
    set: InstructionSet,
    operands: OperandType,
    sizes: AttentionSizes,
    [query, key, value]: [StridedRows<'_>; 3],
    output: &mut [f32],
    log_sum: &mut [f32],
) {
    assert_eq!(output.len(), sizes.batch * sizes.num_queries * sizes.dim(), "output has one row per query");
    assert_eq!(log_sum.len(), sizes.batch * sizes.num_heads * sizes.num_queries, "one sum per query and head");
    if sizes.num_keys == 0 {
        output.fill(0.0);
        log_sum.fill(f32::NEG_INFINITY);
        return;
    }
    let blocks = sizes.num_queries.div_ceil(QUERY_BLOCK);
    // Queries are independent: the number of threads changes no sum. Every part packs all keys and values of its head.
    let parts =
        (2 * rayon::current_num_threads()).div_ceil((sizes.batch * sizes.num_heads).max(1)).clamp(1, blocks.max(1));
    let output = SharedSlice::new(output);
    let output = HeadBlocks { values: &output, count: sizes.num_queries, width: sizes.dim(), first: 0 };
    let log_sum = SharedSlice::new(log_sum);
    (0..sizes.batch * sizes.num_heads * parts).into_par_iter().for_each(|task| {
        let (head, part) = (task / parts, task % parts);
        let bound = |part: usize| (part * blocks / parts * QUERY_BLOCK).min(sizes.num_queries);
        let task = Forward {
            sizes,
            inputs: [query, key, value],
            output,
            log_sum: &log_sum,
            scene: head / sizes.num_heads,
            head: head % sizes.num_heads,
            queries: bound(part)..bound(part + 1),
        };
        set.run_product(operands, task);
    });
}

struct Forward<'a> {
    sizes: AttentionSizes,
    inputs: [StridedRows<'a>; 3],
    output: HeadBlocks<'a>,
    log_sum: &'a SharedSlice<'a>,
    scene: usize,
    head: usize,
    queries: Range<usize>,
}

impl<'a> Kernel for Forward<'a> {
    #[inline(always)]
    fn run<S: Simd, O: Operands>(self, simd: S) {
        let Self { sizes, inputs: [query, key, value], output, log_sum, scene, head, queries } = self;
        let AttentionSizes { num_keys, head_width, .. } = sizes;
        let (width, panel, inner) = (padded::<S>(head_width), panel_width::<S>(), lanes_of::<S, O>(head_width));
        let score_row = num_keys.min(FORWARD_KEYS).next_multiple_of(panel) + ROW_PADDING;
        let key_lanes = lanes_of::<S, O>(num_keys);
        let lens = [
            num_keys.next_multiple_of(panel) * inner,
            key_lanes * width.next_multiple_of(panel),
            QUERY_BLOCK * inner,
            QUERY_BLOCK * score_row,
            QUERY_BLOCK * width,
            QUERY_BLOCK,
            QUERY_BLOCK,
        ];
        let mut scratch = Scratch::take(lens.iter().sum());
        let [keys, values, block, scores, sums, highest, total] = scratch.cut(lens);
        let rows_of =
            |rows: StridedRows<'a>, range: Range<usize>| range.map(move |row| rows.head(&sizes, scene, row, head));
        pack_transposed::<S, O>(simd, rows_of(key, 0..num_keys), [inner, panel], keys);
        pack_panels::<S, O>(simd, rows_of(value, 0..num_keys), [key_lanes, panel], values);
        for start in queries.clone().step_by(QUERY_BLOCK) {
            let rows = QUERY_BLOCK.min(queries.end - start);
            pack_rows::<S, O>(simd, rows_of(query, start..start + rows), inner, block);
            sums.fill(0.0);
            highest.fill(f32::NEG_INFINITY);
            total.fill(0.0);
            for first_key in (0..num_keys).step_by(FORWARD_KEYS) {
                let count = FORWARD_KEYS.min(num_keys - first_key);
                let left = Left { values: block, row: inner, step: 1 };
                let right = Right { values: &keys[first_key * inner..], step: panel, panel: panel * inner };
                multiply::<S, O>(simd, [rows, inner, count], left, right, (scores, score_row), false);
                for row in 0..rows {
                    let scores = &mut scores[row * score_row..][..score_row];
                    let factor = sizes.exponent_scale();
                    // Columns that fill up the last vector have no weight.
                    let whole = &mut scores[..padded::<S>(count)];
                    whole[count..].fill(f32::NEG_INFINITY);
                    let shrink = exponentials::<S, O>(simd, whole, factor, &mut highest[row], &mut total[row]);
                    pack_in_place::<S, O>(simd, scores, count);
                    if shrink != 1.0 {
                        scale(simd, &mut sums[row * width..][..width], shrink);
                    }
                }
                let left = Left { values: scores, row: score_row, step: 1 };
                let values = &values[lanes_of::<S, O>(first_key) * panel..];
                let right = Right { values, step: panel, panel: key_lanes * panel };
                multiply::<S, O>(simd, [rows, lanes_of::<S, O>(count), head_width], left, right, (sums, width), true);
            }
            for row in 0..rows {
                let inverse = 1.0 / total[row];
                let result = sums[row * width..][..head_width].iter().map(|sum| sum * inverse);
                // SAFETY: no other task has this query of this head.
                unsafe { output.write([scene, start + row, head], result) };
            }
            let first = (scene * sizes.num_heads + head) * sizes.num_queries + start;
            // SAFETY: no other task has this query of this head.
            let to = unsafe { log_sum.part(first, rows) };
            for (row, to) in to.iter_mut().enumerate() {
                *to = highest[row] + total[row].log2();
            }
        }
    }
}

/// Replaces a row of scores by `2^(score * scale - highest)` with the highest scaled score so far, adds the results to
/// `total`, and returns the factor that rescales earlier sums to the new highest score.
#[inline(always)]
fn exponentials<S: Simd, O: Operands>(
    simd: S,
    scores: &mut [f32],
    scale: f32,
    highest: &mut f32,
    total: &mut f32,
) -> f32 {
    let mut largest = simd.splat(f32::NEG_INFINITY);
    for chunk in scores.chunks_exact(S::LANES) {
        largest = simd.max(largest, simd.read(chunk));
    }
    let largest = simd.largest(largest);
    let former = *highest;
    let raised = if former > largest * scale { former } else { largest * scale };
    let shrink = if former == raised { 1.0 } else { (former - raised).exp2() };
    let (factor, shift) = (simd.splat(scale), simd.splat(-raised));
    let mut sum = simd.splat(0.0);
    for chunk in scores.chunks_exact_mut(S::LANES) {
        let weight = O::exp2(simd, simd.mul_add(simd.read(chunk), factor, shift));
        simd.write(chunk, weight);
        sum = simd.add(sum, weight);
    }
    *highest = raised;
    *total = *total * shrink + simd.sum(sum);
    shrink
}

#[inline(always)]
fn scale<S: Simd>(simd: S, values: &mut [f32], factor: f32) {
    let factor = simd.splat(factor);
    for chunk in values.chunks_exact_mut(S::LANES) {
        simd.write(chunk, simd.mul(simd.read(chunk), factor));
    }
}
