//! Attention in chunks of queries, on any backend.
// B scenes, N tokens, Q queries, K keys, D width, H heads, E width of a head

use std::ops::Range;

use burn::backend::tensor::FloatTensor;
use burn::backend::{Backend, TensorMetadata};
use burn::tensor::Shape;

use crate::ops::composed::primitives::{narrow, score_scale};

/// Returns for queries, keys and values the input that has them, their place among the parts of its rows, and the number of
/// these parts. One input has all three side by side, `[B, N, 3D]`; of two the first has queries, `[B, Q, D]`, and the second keys
/// and values side by side, `[B, K, 2D]`.
pub(crate) const fn parts<const N: usize>() -> [[usize; 3]; 3] {
    if N == 1 { [[0, 0, 3], [0, 1, 3], [0, 2, 3]] } else { [[0, 0, 1], [1, 0, 2], [1, 1, 2]] }
}

fn split<B: Backend, const N: usize>(inputs: &[FloatTensor<B>; N]) -> [FloatTensor<B>; 3] {
    parts::<N>().map(|[input, part, parts]| {
        let dim = inputs[input].shape()[2] / parts;
        narrow::<B>(&inputs[input], 2, part * dim..(part + 1) * dim)
    })
}

/// Most scores in memory at once, over all scenes and heads: 64 MiB in f32. A scene of 4,096 tokens with 8 heads takes 8
/// chunks of 512 queries.
pub(crate) const MAX_SCORES: usize = 1 << 24;

/// Divides the queries into ranges of at most [`MAX_SCORES`] scores each.
pub(crate) fn query_chunks(batch: usize, num_heads: usize, num_queries: usize, num_keys: usize) -> Vec<Range<usize>> {
    let chunk = (MAX_SCORES / (batch * num_heads * num_keys).max(1)).clamp(1, num_queries.max(1));
    (0..num_queries).step_by(chunk).map(|start| start..(start + chunk).min(num_queries)).collect()
}

/// Computes `softmax(s q k^T) v` per head, a chunk of queries at a time.
pub(crate) fn forward<B: Backend, const N: usize>(
    inputs: &[FloatTensor<B>; N],
    num_heads: usize,
    matmul: impl Fn(FloatTensor<B>, FloatTensor<B>) -> FloatTensor<B>,
) -> FloatTensor<B> {
    let [query, key, value] = split::<B, N>(inputs);
    let [batch, num_queries, dim] = query.shape().dims();
    let num_keys = key.shape()[1];
    let query = split_heads::<B>(B::float_mul_scalar(query, score_scale(dim, num_heads).into()), num_heads);
    let key_t = B::float_swap_dims(split_heads::<B>(key, num_heads), 2, 3); // [B, H, E, K]
    let value = split_heads::<B>(value, num_heads);
    let chunks = query_chunks(batch, num_heads, num_queries, num_keys).into_iter().map(|range| {
        let scores = matmul(narrow::<B>(&query, 2, range), key_t.clone()); // [B, H, chunk, K]
        matmul(B::softmax(scores, 3), value.clone())
    });
    merge_heads::<B>(concat::<B>(chunks.collect()))
}

/// Computes the gradients of the inputs, a chunk of queries at a time.
///
/// With `P = softmax(s q k^T)`: `dV = P^T dO`, `dS = P * (dO V^T - rowsum(dO * O))`, `dQ = s dS K`, `dK = s dS^T Q`.
pub(crate) fn backward<B: Backend, const N: usize>(
    inputs: &[FloatTensor<B>; N],
    output: FloatTensor<B>,
    num_heads: usize,
    grad_output: FloatTensor<B>,
    matmul: impl Fn(FloatTensor<B>, FloatTensor<B>) -> FloatTensor<B>,
) -> [FloatTensor<B>; N] {
    let [query, key, value] = split::<B, N>(inputs);
    let [batch, num_queries, dim] = query.shape().dims();
    let num_keys = key.shape()[1];
    let head_width = dim / num_heads;
    let scale = score_scale(dim, num_heads);

    // rowsum(dO * O) per head: [B, H, Q, 1]
    let delta = B::float_reshape(
        B::float_mul(grad_output.clone(), output),
        Shape::new([batch, num_queries, num_heads, head_width]),
    );
    let delta = B::float_swap_dims(B::float_sum_dim(delta, 3), 1, 2);
    let query = split_heads::<B>(B::float_mul_scalar(query, scale.into()), num_heads);
    let key = split_heads::<B>(key, num_heads);
    let key_t = B::float_swap_dims(key.clone(), 2, 3);
    let value_t = B::float_swap_dims(split_heads::<B>(value, num_heads), 2, 3);
    let grad_output = split_heads::<B>(grad_output, num_heads);

    let mut grad_query = Vec::new();
    let mut grad_key_value: Option<(FloatTensor<B>, FloatTensor<B>)> = None;
    for range in query_chunks(batch, num_heads, num_queries, num_keys) {
        let query = narrow::<B>(&query, 2, range.clone());
        let grad_output = narrow::<B>(&grad_output, 2, range.clone());
        let weights = B::softmax(matmul(query.clone(), key_t.clone()), 3);
        let grad_weights = matmul(grad_output.clone(), value_t.clone());
        let grad_scores = B::float_mul(weights.clone(), B::float_sub(grad_weights, narrow::<B>(&delta, 2, range)));
        let grad_value = matmul(B::float_swap_dims(weights, 2, 3), grad_output);
        // The query is already scaled.
        let grad_key = matmul(B::float_swap_dims(grad_scores.clone(), 2, 3), query);
        grad_query.push(matmul(grad_scores, key.clone()));
        grad_key_value = Some(match grad_key_value {
            None => (grad_key, grad_value),
            Some((key_sum, value_sum)) => (B::float_add(key_sum, grad_key), B::float_add(value_sum, grad_value)),
        });
    }
    let (grad_key, grad_value) = grad_key_value.expect("attention has at least one query");
    let grad_query = B::float_mul_scalar(merge_heads::<B>(concat::<B>(grad_query)), scale.into());
    let grads = [grad_query, merge_heads::<B>(grad_key), merge_heads::<B>(grad_value)];
    std::array::from_fn(|input| {
        let own = parts::<N>().into_iter().zip(grads.clone()).filter(|([of, ..], _)| *of == input);
        concat::<B>(own.map(|(_, grad)| grad).collect())
    })
}

/// `[B, N, D] -> [B, H, N, E]`
fn split_heads<B: Backend>(x: FloatTensor<B>, num_heads: usize) -> FloatTensor<B> {
    let [batch, count, dim] = x.shape().dims();
    B::float_swap_dims(B::float_reshape(x, Shape::new([batch, count, num_heads, dim / num_heads])), 1, 2)
}

/// `[B, H, N, E] -> [B, N, D]`
fn merge_heads<B: Backend>(x: FloatTensor<B>) -> FloatTensor<B> {
    let [batch, num_heads, count, head_width] = x.shape().dims();
    B::float_reshape(B::float_swap_dims(x, 1, 2), Shape::new([batch, count, num_heads * head_width]))
}

fn concat<B: Backend>(mut chunks: Vec<FloatTensor<B>>) -> FloatTensor<B> {
    if chunks.len() == 1 { chunks.remove(0) } else { B::float_cat(chunks, 2) }
}
