//! Attention in chunks of queries, on any backend.

use burn::backend::tensor::FloatTensor;
use burn::backend::{Backend, TensorMetadata};
use burn::tensor::{Shape, Slice};

use crate::ops::precision::{MatmulKernels, Precision};

/// Number of heads and precision of an attention.
#[derive(Clone, Copy, Debug)]
pub struct HeadConfig {
    pub(crate) num_heads: usize,
    pub(crate) precision: Precision,
}

impl HeadConfig {
    pub(crate) fn now(num_heads: usize) -> Self {
        Self { num_heads, precision: Precision::current() }
    }
}

/// Queries, keys and values, as the projections return them.
#[derive(Clone, Debug)]
pub enum Qkv<T> {
    /// Queries, keys and values side by side: `[B, N, 3D]`.
    Packed(T),
    Separate {
        /// Queries, `[B, Q, D]`.
        query: T,
        /// Keys and values side by side: `[B, K, 2D]`.
        key_value: T,
    },
}

impl<T> Qkv<T> {
    pub(crate) fn map<U>(self, function: impl Fn(T) -> U) -> Qkv<U> {
        match self {
            Self::Packed(packed) => Qkv::Packed(function(packed)),
            Self::Separate { query, key_value } => {
                Qkv::Separate { query: function(query), key_value: function(key_value) }
            }
        }
    }
}

#[derive(Clone, Debug)]
pub struct AttentionOutput<T> {
    /// Output, `[B, Q, D]`.
    pub output: T,
    /// Logarithm of the sum of every row of scores, `[B, H, Q]`, if the native kernel computed it.
    pub log_sum: Option<T>,
}

/// Splits into queries, keys and values, each `[B, N, D]`.
fn split<B: Backend>(inputs: &Qkv<FloatTensor<B>>) -> [FloatTensor<B>; 3] {
    let part = |packed: &FloatTensor<B>, parts: usize, part: usize| {
        let [batch, count, width] = packed.shape().dims();
        let dim = width / parts;
        B::float_slice(packed.clone(), &[0..batch, 0..count, part * dim..(part + 1) * dim].map(Slice::from))
    };
    match inputs {
        Qkv::Packed(packed) => [0, 1, 2].map(|i| part(packed, 3, i)),
        Qkv::Separate { query, key_value } => [query.clone(), part(key_value, 2, 0), part(key_value, 2, 1)],
    }
}

/// Most scores in memory at once, over all scenes and heads: 64 MiB in f32. A scene of 4,096 tokens with 8 heads takes 8
/// chunks of 512 queries.
pub const MAX_SCORES: usize = 1 << 24;

/// Divides the queries into ranges of at most [`MAX_SCORES`] scores each.
pub(crate) fn query_chunks(batch: usize, num_heads: usize, num_queries: usize, num_keys: usize) -> Vec<(usize, usize)> {
    let chunk = (MAX_SCORES / (batch * num_heads * num_keys).max(1)).clamp(1, num_queries.max(1));
    (0..num_queries).step_by(chunk).map(|start| (start, (start + chunk).min(num_queries))).collect()
}

/// Computes `softmax(s q k^T) v` per head, a chunk of queries at a time.
pub(crate) fn composed_forward<B: MatmulKernels>(
    inputs: &Qkv<FloatTensor<B>>,
    HeadConfig { num_heads, precision }: HeadConfig,
) -> AttentionOutput<FloatTensor<B>> {
    let [query, key, value] = split::<B>(inputs);
    let [batch, num_queries, dim] = query.shape().dims();
    let num_keys = key.shape()[1];
    let query = split_heads::<B>(B::float_mul_scalar(query, scale(dim, num_heads).into()), num_heads);
    let key_t = B::float_swap_dims(split_heads::<B>(key, num_heads), 2, 3); // [B, H, E, K]
    let value = split_heads::<B>(value, num_heads);
    let chunks = query_chunks(batch, num_heads, num_queries, num_keys).into_iter().map(|range| {
        let scores = B::matmul(precision, rows::<B>(&query, range), key_t.clone()); // [B, H, chunk, K]
        B::matmul(precision, B::softmax(scores, 3), value.clone())
    });
    AttentionOutput { output: merge_heads::<B>(concat::<B>(chunks.collect())), log_sum: None }
}

/// Computes the gradients of the inputs, a chunk of queries at a time.
///
/// With `P = softmax(s q k^T)`: `dV = P^T dO`, `dS = P * (dO V^T - rowsum(dO * O))`, `dQ = s dS K`, `dK = s dS^T Q`.
pub(crate) fn composed_backward<B: MatmulKernels>(
    inputs: &Qkv<FloatTensor<B>>,
    output: FloatTensor<B>,
    HeadConfig { num_heads, precision }: HeadConfig,
    grad_output: FloatTensor<B>,
) -> Qkv<FloatTensor<B>> {
    let [query, key, value] = split::<B>(inputs);
    let [batch, num_queries, dim] = query.shape().dims();
    let num_keys = key.shape()[1];
    let head_width = dim / num_heads;
    let scale = scale(dim, num_heads);

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
        let query = rows::<B>(&query, range);
        let grad_output = rows::<B>(&grad_output, range);
        let weights = B::softmax(B::matmul(precision, query.clone(), key_t.clone()), 3);
        let grad_weights = B::matmul(precision, grad_output.clone(), value_t.clone());
        let grad_scores = B::float_mul(weights.clone(), B::float_sub(grad_weights, rows::<B>(&delta, range)));
        let grad_value = B::matmul(precision, B::float_swap_dims(weights, 2, 3), grad_output);
        // The query is already scaled.
        let grad_key = B::matmul(precision, B::float_swap_dims(grad_scores.clone(), 2, 3), query);
        grad_query.push(B::matmul(precision, grad_scores, key.clone()));
        grad_key_value = Some(match grad_key_value {
            None => (grad_key, grad_value),
            Some((key_sum, value_sum)) => (B::float_add(key_sum, grad_key), B::float_add(value_sum, grad_value)),
        });
    }
    let (grad_key, grad_value) = grad_key_value.expect("attention has at least one query");
    let grad_query = B::float_mul_scalar(merge_heads::<B>(concat::<B>(grad_query)), scale.into());
    let (grad_key, grad_value) = (merge_heads::<B>(grad_key), merge_heads::<B>(grad_value));
    match inputs {
        Qkv::Packed(_) => Qkv::Packed(B::float_cat(vec![grad_query, grad_key, grad_value], 2)),
        Qkv::Separate { .. } => {
            Qkv::Separate { query: grad_query, key_value: B::float_cat(vec![grad_key, grad_value], 2) }
        }
    }
}

fn scale(dim: usize, num_heads: usize) -> f64 {
    1.0 / ((dim / num_heads) as f64).sqrt()
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

/// Returns rows `start..end` of every head.
fn rows<B: Backend>(x: &FloatTensor<B>, (start, end): (usize, usize)) -> FloatTensor<B> {
    let [batch, num_heads, count, width] = x.shape().dims();
    if (start, end) == (0, count) {
        return x.clone();
    }
    B::float_slice(x.clone(), &[0..batch, 0..num_heads, start..end, 0..width].map(Slice::from))
}

fn concat<B: Backend>(mut chunks: Vec<FloatTensor<B>>) -> FloatTensor<B> {
    if chunks.len() == 1 { chunks.remove(0) } else { B::float_cat(chunks, 2) }
}
