//! Scaled dot-product attention without a score matrix: blocks of queries against blocks of keys,
//! all in the cache (the scheme of Dao et al. 2022, "`FlashAttention`").
//!
//! Heads are read where they lie, by stride, in rows that may be part of wider ones (packed
//! projections); each task copies its head once into a contiguous block.
// B scenes, H heads, Q queries, K keys, E width of a head

use std::ops::Range;

use rayon::prelude::*;

use crate::InstructionSet;
use crate::disjoint::Disjoint;
use crate::instruction_set::Kernel;
use crate::matmul::{Left, Right, multiply, padded, panel_width};
use crate::scratch::{Scratch, cut};
use crate::simd::Simd;

/// Sizes of one attention.
#[derive(Clone, Copy, Debug)]
pub struct Sizes {
    /// Scenes.
    pub batch: usize,
    /// Queries of a scene.
    pub num_queries: usize,
    /// Keys of a scene.
    pub num_keys: usize,
    /// Heads.
    pub num_heads: usize,
    /// Width of a head.
    pub head_width: usize,
}

impl Sizes {
    fn dim(&self) -> usize {
        self.num_heads * self.head_width
    }

    fn scale(&self) -> f32 {
        (1.0 / (self.head_width as f64).sqrt()) as f32
    }

    /// How many parts a head's work is cut into, so that 16 threads find work. A matter of shape
    /// alone, because sums over parts depend on it.
    fn parts(&self, blocks: usize) -> usize {
        16_usize.div_ceil((self.batch * self.num_heads).max(1)).clamp(1, blocks.max(1))
    }
}

/// Rows of tokens inside a slice that may hold more: `[batch, count, dim]` with strides.
#[derive(Clone, Copy, Debug)]
pub struct Rows<'a> {
    /// From the first value on.
    pub values: &'a [f32],
    /// Distance of two scenes.
    pub batch_stride: usize,
    /// Distance of two rows.
    pub row_stride: usize,
}

impl<'a> Rows<'a> {
    /// One head of one row.
    fn head(&self, sizes: &Sizes, scene: usize, row: usize, head: usize) -> &'a [f32] {
        let start = scene * self.batch_stride + row * self.row_stride + head * sizes.head_width;
        &self.values[start..start + sizes.head_width]
    }
}

/// Where [`backward`] puts its gradients, in contiguous rows.
#[derive(Debug)]
pub enum Gradients<'a> {
    /// Those of queries, keys and values side by side: `[batch, num_queries, 3 dim]`.
    Packed(&'a mut [f32]),
    /// Those of the queries on their own.
    Separate {
        /// `[batch, num_queries, dim]`
        query: &'a mut [f32],
        /// Those of keys and values side by side: `[batch, num_keys, 2 dim]`
        key_value: &'a mut [f32],
    },
}

/// Heads of contiguous rows that several threads write, each its own.
#[derive(Clone, Copy)]
struct Heads<'a> {
    values: &'a Disjoint<'a>,
    /// Rows of a scene.
    count: usize,
    /// Values of a row, and where in it the first head starts.
    width: usize,
    first: usize,
}

impl Heads<'_> {
    /// Writes one head of one row.
    ///
    /// # Safety
    /// No other thread may write or read the same head of the same row.
    unsafe fn write(&self, [scene, row, head]: [usize; 3], values: impl ExactSizeIterator<Item = f32>) {
        let start = (scene * self.count + row) * self.width + self.first + head * values.len();
        // SAFETY: the caller's.
        let place = unsafe { self.values.part(start, values.len()) };
        place.iter_mut().zip(values).for_each(|(to, value)| *to = value);
    }
}

/// Queries in a block.
const QUERY_BLOCK: usize = 96;
/// Keys in a block of the forward pass: scores of a block take 200 KB.
const FORWARD_KEYS: usize = 512;
/// Keys in a block of the backward pass, which holds two blocks of scores and two of gradients.
const BACKWARD_KEYS: usize = 256;
/// Added to the length of a row of scores: rows a power of two apart would share cache sets.
const ROW_PADDING: usize = 16;

/// Computes `softmax(q k^T / sqrt(head width)) v` per head.
///
/// `output` is `[batch, num_queries, dim]`; `log_sum`, if wanted, is `[batch, num_heads, num_queries]` and
/// receives each row's `log2(sum(2^(score * log2(e))))`, which [`backward`] needs.
pub fn forward(
    set: InstructionSet,
    sizes: Sizes,
    [query, key, value]: [Rows<'_>; 3],
    output: &mut [f32],
    log_sum: Option<&mut [f32]>,
) {
    assert_eq!(output.len(), sizes.batch * sizes.num_queries * sizes.dim(), "a row for every query");
    if sizes.num_keys == 0 {
        output.fill(0.0);
        return;
    }
    let blocks = sizes.num_queries.div_ceil(QUERY_BLOCK);
    let parts = sizes.parts(blocks);
    let output = Disjoint::new(output);
    let output = Heads { values: &output, count: sizes.num_queries, width: sizes.dim(), first: 0 };
    let log_sum = log_sum.map(Disjoint::new);
    (0..sizes.batch * sizes.num_heads * parts).into_par_iter().for_each(|task| {
        let (head, part) = (task / parts, task % parts);
        let bound = |part: usize| (part * blocks / parts * QUERY_BLOCK).min(sizes.num_queries);
        set.run(Forward {
            sizes,
            query,
            key,
            value,
            output,
            log_sum: log_sum.as_ref(),
            scene: head / sizes.num_heads,
            head: head % sizes.num_heads,
            queries: bound(part)..bound(part + 1),
        });
    });
}

struct Forward<'a> {
    sizes: Sizes,
    query: Rows<'a>,
    key: Rows<'a>,
    value: Rows<'a>,
    output: Heads<'a>,
    log_sum: Option<&'a Disjoint<'a>>,
    scene: usize,
    head: usize,
    queries: Range<usize>,
}

impl Kernel for Forward<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { sizes, query, key, value, output, log_sum, scene, head, queries } = self;
        let Sizes { num_keys, head_width, .. } = sizes;
        let (width, panel) = (padded::<S>(head_width), panel_width::<S>());
        let score_row = num_keys.min(FORWARD_KEYS).next_multiple_of(panel) + ROW_PADDING;
        let lens = [
            num_keys.next_multiple_of(panel) * head_width,
            num_keys * width,
            QUERY_BLOCK * head_width,
            QUERY_BLOCK * score_row,
            QUERY_BLOCK * width,
            QUERY_BLOCK,
            QUERY_BLOCK,
        ];
        let mut scratch = Scratch::take(lens.iter().sum());
        let [keys, values, block, scores, sums, highest, total] = cut(&mut scratch, lens);
        copy_transposed(keys, panel, head_width, (0..num_keys).map(|row| key.head(&sizes, scene, row, head)));
        copy_padded(values, width, (0..num_keys).map(|row| value.head(&sizes, scene, row, head)));
        for start in queries.clone().step_by(QUERY_BLOCK) {
            let rows = QUERY_BLOCK.min(queries.end - start);
            copy_padded(block, head_width, (start..start + rows).map(|row| query.head(&sizes, scene, row, head)));
            sums.fill(0.0);
            highest.fill(f32::NEG_INFINITY);
            total.fill(0.0);
            for first_key in (0..num_keys).step_by(FORWARD_KEYS) {
                let count = FORWARD_KEYS.min(num_keys - first_key);
                let left = Left { values: block, row: head_width, step: 1 };
                let right = Right { values: &keys[first_key * head_width..], step: panel, panel: panel * head_width };
                multiply(simd, [rows, head_width, count], left, right, (scores, score_row), false);
                for row in 0..rows {
                    let shrink = exponentials(
                        simd,
                        &mut scores[row * score_row..][..count],
                        sizes.scale() * std::f32::consts::LOG2_E,
                        &mut highest[row],
                        &mut total[row],
                    );
                    if shrink != 1.0 {
                        scale(simd, &mut sums[row * width..][..width], shrink);
                    }
                }
                let left = Left { values: scores, row: score_row, step: 1 };
                let right = Right { values: &values[first_key * width..], step: width, panel };
                multiply(simd, [rows, count, head_width], left, right, (sums, width), true);
            }
            for row in 0..rows {
                let result = sums[row * width..][..head_width].iter().map(|sum| sum / total[row]);
                // SAFETY: no other task has this query of this head.
                unsafe { output.write([scene, start + row, head], result) };
            }
            if let Some(log_sum) = log_sum {
                let place = (scene * sizes.num_heads + head) * sizes.num_queries + start;
                // SAFETY: no other task has this query of this head.
                let to = unsafe { log_sum.part(place, rows) };
                for (row, to) in to.iter_mut().enumerate() {
                    *to = highest[row] + total[row].log2();
                }
            }
        }
    }
}

/// Turns a row of scores into `2^(score * scale - highest)` with the highest scaled score so far, adds
/// them to `total`, and returns the factor that brings what was summed before to the new height.
#[inline(always)]
fn exponentials<S: Simd>(simd: S, scores: &mut [f32], scale: f32, highest: &mut f32, total: &mut f32) -> f32 {
    let full = scores.len() / S::LANES * S::LANES;
    let mut largest = simd.splat(f32::NEG_INFINITY);
    for chunk in scores[..full].chunks_exact(S::LANES) {
        largest = simd.max(largest, simd.read(chunk));
    }
    let largest = scores[full..].iter().fold(simd.largest(largest), |a, &b| if a > b { a } else { b });
    let before = *highest;
    let height = if before > largest * scale { before } else { largest * scale };
    let shrink = if before == height { 1.0 } else { (before - height).exp2() };

    let (factor, shift) = (simd.splat(scale), simd.splat(-height));
    let mut sum = simd.splat(0.0);
    for chunk in scores[..full].chunks_exact_mut(S::LANES) {
        let weight = simd.exp2(simd.mul_add(simd.read(chunk), factor, shift));
        simd.write(chunk, weight);
        sum = simd.add(sum, weight);
    }
    let rest = &mut scores[full..];
    let weight = simd.exp2(simd.mul_add(simd.read(rest), factor, shift));
    simd.write(rest, weight);
    *highest = height;
    *total = *total * shrink + simd.sum(sum) + rest.iter().sum::<f32>();
    shrink
}

#[inline(always)]
fn scale<S: Simd>(simd: S, values: &mut [f32], factor: f32) {
    let factor = simd.splat(factor);
    for chunk in values.chunks_exact_mut(S::LANES) {
        simd.write(chunk, simd.mul(simd.read(chunk), factor));
    }
}

/// Copies rows one after the other, each followed by zeros up to `width`.
#[inline(always)]
fn copy_padded<'a>(to: &mut [f32], width: usize, rows: impl Iterator<Item = &'a [f32]>) {
    for (to, row) in to.chunks_exact_mut(width).zip(rows) {
        to[..row.len()].copy_from_slice(row);
        to[row.len()..].fill(0.0);
    }
}

/// Copies rows as columns of panels: a panel is `[head_width, panel]`, the last one padded with zeros.
#[inline(always)]
fn copy_transposed<'a>(
    to: &mut [f32],
    panel: usize,
    head_width: usize,
    mut rows: impl ExactSizeIterator<Item = &'a [f32]>,
) {
    for to in to.chunks_exact_mut(panel * head_width) {
        let columns = panel.min(rows.len());
        if columns < panel {
            to.fill(0.0);
        }
        for column in 0..columns {
            let row = rows.next().expect("the iterator has as many");
            for (to, &value) in to[column..].iter_mut().step_by(panel).zip(row) {
                *to = value;
            }
        }
    }
}

/// What [`backward`] reads: the inputs and the results of [`forward`], and the output's gradient.
#[derive(Clone, Copy, Debug)]
pub struct Saved<'a> {
    /// Queries.
    pub query: Rows<'a>,
    /// Keys.
    pub key: Rows<'a>,
    /// Values.
    pub value: Rows<'a>,
    /// Output of the forward pass.
    pub output: Rows<'a>,
    /// Row sums of the forward pass, `[batch, num_heads, num_queries]`.
    pub log_sum: &'a [f32],
    /// Gradient of the output.
    pub grad_output: Rows<'a>,
}

/// Computes the gradients of queries, keys and values.
///
/// With `P = softmax(s q k^T)`: `dV = P^T dO`, `dS = P * (dO V^T - rowsum(dO * O))`, `dQ = s dS K`,
/// `dK = s dS^T Q`; the scores are computed again, a block at a time.
pub fn backward(set: InstructionSet, sizes: Sizes, saved: Saved<'_>, to: Gradients<'_>) {
    let Sizes { batch, num_queries, num_keys, num_heads, .. } = sizes;
    let dim = sizes.dim();
    assert_eq!(saved.log_sum.len(), batch * num_heads * num_queries, "a sum for every row of scores");
    match to {
        Gradients::Packed(packed) => {
            assert!(packed.len() == batch * num_queries * 3 * dim && num_keys == num_queries);
            let packed = Disjoint::new(packed);
            let part = |part| Heads { values: &packed, count: num_queries, width: 3 * dim, first: part * dim };
            backward_into(set, sizes, saved, [part(0), part(1), part(2)]);
        }
        Gradients::Separate { query, key_value } => {
            assert!(query.len() == batch * num_queries * dim && key_value.len() == batch * num_keys * 2 * dim);
            let (query, key_value) = (Disjoint::new(query), Disjoint::new(key_value));
            let part = |part| Heads { values: &key_value, count: num_keys, width: 2 * dim, first: part * dim };
            let query = Heads { values: &query, count: num_queries, width: dim, first: 0 };
            backward_into(set, sizes, saved, [query, part(0), part(1)]);
        }
    }
}

/// The three parts must not overlap.
fn backward_into(
    set: InstructionSet,
    sizes: Sizes,
    saved: Saved<'_>,
    [grad_query, grad_key, grad_value]: [Heads<'_>; 3],
) {
    let Sizes { num_queries, num_keys, num_heads, head_width, .. } = sizes;
    let blocks = num_keys.div_ceil(BACKWARD_KEYS);
    let parts = sizes.parts(blocks);
    let tasks = sizes.batch * num_heads * parts;
    // A part of the keys gives a part of every query's gradient.
    let partial: Vec<Vec<f32>> = (0..tasks)
        .into_par_iter()
        .map(|task| {
            let (head, part) = (task / parts, task % parts);
            let bound = |part: usize| (part * blocks / parts * BACKWARD_KEYS).min(num_keys);
            set.run(BackwardTask {
                sizes,
                saved,
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
    sizes: Sizes,
    saved: Saved<'a>,
    grad_key: Heads<'a>,
    grad_value: Heads<'a>,
    scene: usize,
    head: usize,
    keys: Range<usize>,
}

impl<'a> Kernel for BackwardTask<'a> {
    /// Gradients of all queries from these keys before scaling, in rows of the padded head width.
    type Output = Vec<f32>;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> Vec<f32> {
        let Self { sizes, saved, grad_key, grad_value, scene, head, keys } = self;
        let Sizes { num_queries, num_keys, num_heads, head_width, .. } = sizes;
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
        let head_of = |rows: &Rows<'a>, row: usize| rows.head(&sizes, scene, row, head);
        let mut scratch = Scratch::take(lens.iter().sum());
        let [queries, grads, delta, keys_t, values_t, key_rows, key_sums, value_sums, weights, slopes] =
            cut(&mut scratch, lens);
        copy_padded(queries, width, (0..num_queries).map(|row| head_of(&saved.query, row)));
        copy_padded(grads, width, (0..num_queries).map(|row| head_of(&saved.grad_output, row)));
        for (row, to) in delta.iter_mut().enumerate() {
            let pairs = head_of(&saved.output, row).iter().zip(head_of(&saved.grad_output, row));
            *to = pairs.map(|(a, b)| a * b).sum();
        }
        let log_sum = &saved.log_sum[(scene * num_heads + head) * num_queries..][..num_queries];

        for first_key in keys.clone().step_by(BACKWARD_KEYS) {
            let count = BACKWARD_KEYS.min(keys.end - first_key);
            let rows = first_key..first_key + count;
            copy_transposed(keys_t, panel, head_width, rows.clone().map(|row| head_of(&saved.key, row)));
            copy_transposed(values_t, panel, head_width, rows.clone().map(|row| head_of(&saved.value, row)));
            copy_padded(key_rows, width, rows.clone().map(|row| head_of(&saved.key, row)));
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
                let place = [scene, first_key + row, head];
                let key_row = key_sums[row * width..][..head_width].iter().map(|sum| sum * sizes.scale());
                let value_row = value_sums[row * width..][..head_width].iter().copied();
                // SAFETY: no other task has this key of this head.
                unsafe {
                    grad_key.write(place, key_row);
                    grad_value.write(place, value_row);
                }
            }
        }
        grad_query
    }
}

/// Turns a row of scores into weights `P`, and the weights' gradients beside it into the scores'.
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
mod tests {
    use super::*;
    use crate::testing::{assert_close, random};

    /// Contiguous rows.
    fn rows(values: &[f32], sizes: &Sizes, count: usize) -> Rows<'static> {
        let values: &'static [f32] = values.to_vec().leak();
        Rows { values, batch_stride: count * sizes.dim(), row_stride: sizes.dim() }
    }

    /// Output and gradients of queries, keys and values in f64, as the formulas are printed.
    fn reference(sizes: &Sizes, [q, k, v, grad]: [&[f32]; 4]) -> [Vec<f64>; 4] {
        let Sizes { batch, num_queries, num_keys, num_heads, head_width } = *sizes;
        let dim = sizes.dim();
        let scale = 1.0 / (head_width as f64).sqrt();
        let mut results = [q.len(), q.len(), k.len(), v.len()].map(|len| vec![0.0_f64; len]);
        let [output, grad_q, grad_k, grad_v] = &mut results;
        for (scene, head) in (0..batch).flat_map(|scene| (0..num_heads).map(move |head| (scene, head))) {
            let at = |count: usize, row: usize, e: usize| (scene * count + row) * dim + head * head_width + e;
            for i in 0..num_queries {
                let dot = |a: &[f32], j: usize, b: &[f32]| -> f64 {
                    (0..head_width)
                        .map(|e| f64::from(a[at(num_queries, i, e)]) * f64::from(b[at(num_keys, j, e)]))
                        .sum()
                };
                let scores: Vec<f64> = (0..num_keys).map(|j| dot(q, j, k) * scale).collect();
                let highest = scores.iter().copied().fold(f64::MIN, f64::max);
                let total: f64 = scores.iter().map(|score| (score - highest).exp()).sum();
                let weights: Vec<f64> = scores.iter().map(|score| (score - highest).exp() / total).collect();
                let slopes: Vec<f64> = (0..num_keys).map(|j| dot(grad, j, v)).collect();
                let mean: f64 = weights.iter().zip(&slopes).map(|(weight, slope)| weight * slope).sum();
                for j in 0..num_keys {
                    let grad_score = weights[j] * (slopes[j] - mean) * scale;
                    for e in 0..head_width {
                        let (row, column) = (at(num_queries, i, e), at(num_keys, j, e));
                        output[row] += weights[j] * f64::from(v[column]);
                        grad_q[row] += grad_score * f64::from(k[column]);
                        grad_k[column] += grad_score * f64::from(q[row]);
                        grad_v[column] += weights[j] * f64::from(grad[row]);
                    }
                }
            }
        }
        results
    }

    /// The gradients of queries, keys and values, unpacked.
    fn gradients(set: InstructionSet, sizes: Sizes, saved: Saved<'_>) -> [Vec<f32>; 3] {
        let Sizes { batch, num_queries, num_keys, .. } = sizes;
        let dim = sizes.dim();
        let part = |packed: &[f32], parts: usize, part: usize| {
            packed.chunks_exact(parts * dim).flat_map(|row| row[part * dim..(part + 1) * dim].to_vec()).collect()
        };
        let mut query = vec![f32::NAN; batch * num_queries * dim];
        let mut key_value = vec![f32::NAN; batch * num_keys * 2 * dim];
        backward(set, sizes, saved, Gradients::Separate { query: &mut query, key_value: &mut key_value });
        let separate = [query, part(&key_value, 2, 0), part(&key_value, 2, 1)];
        if num_queries == num_keys {
            let mut packed = vec![f32::NAN; batch * num_queries * 3 * dim];
            backward(set, sizes, saved, Gradients::Packed(&mut packed));
            assert_eq!([0, 1, 2].map(|i| part(&packed, 3, i)), separate);
        }
        separate
    }

    fn check(sizes: Sizes, spread: f32) {
        let Sizes { batch, num_queries, num_keys, num_heads, .. } = sizes;
        let make = |count: usize, seed: u64| random(batch * count * sizes.dim(), seed);
        let mut q = make(num_queries, 1);
        for value in &mut q {
            *value *= spread;
        }
        let (k, v, grad) = (make(num_keys, 2), make(num_keys, 3), make(num_queries, 4));
        let expected = reference(&sizes, [&q, &k, &v, &grad]);
        for set in InstructionSet::available() {
            let mut output = vec![f32::NAN; q.len()];
            let mut log_sum = vec![f32::NAN; batch * num_heads * num_queries];
            let [query, key, value] =
                [rows(&q, &sizes, num_queries), rows(&k, &sizes, num_keys), rows(&v, &sizes, num_keys)];
            forward(set, sizes, [query, key, value], &mut output, Some(&mut log_sum));
            assert_close(&output, &expected[0], 1e-5);
            let saved = Saved {
                query,
                key,
                value,
                output: rows(&output, &sizes, num_queries),
                log_sum: &log_sum,
                grad_output: rows(&grad, &sizes, num_queries),
            };
            let grads = gradients(set, sizes, saved);
            for (grad, expected) in grads.iter().zip(&expected[1..]) {
                // One key: the exact gradient of queries and keys is zero.
                if num_keys > 1 || expected.iter().any(|&value| value != 0.0) {
                    assert_close(grad, expected, 1e-5);
                } else {
                    assert!(grad.iter().all(|value| value.abs() < 1e-5));
                }
            }
        }
    }

    #[test]
    fn every_instruction_set_equals_f64_at_odd_shapes() {
        let sizes = |batch, num_queries, num_keys, num_heads, head_width| Sizes {
            batch,
            num_queries,
            num_keys,
            num_heads,
            head_width,
        };
        check(sizes(1, 1, 7, 1, 12), 1.0);
        check(sizes(2, 5, 1, 2, 12), 1.0);
        check(sizes(1, 97, 601, 2, 12), 3.0);
        check(sizes(2, 131, 67, 3, 96), 1.0);
        check(sizes(1, 13, 1031, 1, 96), 2.0);
        check(sizes(1, 200, 33, 1, 16), 1.0);
        check(sizes(1, 24, 48, 2, 40), 1.0);
        check(sizes(2, 51, 51, 2, 20), 1.0);
    }
}
