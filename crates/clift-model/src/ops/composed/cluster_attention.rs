//! Attention of every centroid to the tokens of its cluster, on any backend.
// B scenes, S centroids, M members, D width, H heads, E = D/H width of a head

use burn::backend::tensor::{FloatTensor, IndexingUpdateOp, IntTensor};
use burn::backend::{Backend, TensorMetadata};
use burn::tensor::{FloatDType, Shape};

use crate::ops::composed::primitives::{narrow, score_scale};

/// The segments of members, and the number of heads.
#[derive(Clone, Debug)]
pub struct Clusters<T> {
    /// Segment of every member, `scene * S + cluster`: `[BM]`.
    pub(crate) segment: T,
    pub(crate) num_heads: usize,
}

/// Splits into keys and values, each `[BM, H, E]`.
fn split<B: Backend>(key_value: FloatTensor<B>, num_heads: usize) -> [FloatTensor<B>; 2] {
    let width = key_value.shape()[2];
    [0..width / 2, width / 2..width].map(|columns| flatten::<B>(narrow::<B>(&key_value, 2, columns), num_heads))
}

/// Computes the output `[B, S, D]` and the weights `[BM, H, 1]` from the queries of the centroids, `[B, S, D]`, and the keys and
/// values of the members side by side, `[B, M, 2D]`.
pub(crate) fn forward<B: Backend>(
    [query, key_value]: [FloatTensor<B>; 2],
    Clusters { segment, num_heads }: Clusters<IntTensor<B>>,
) -> [FloatTensor<B>; 2] {
    let [batch, num_segments, dim] = query.shape().dims();
    let segments = batch * num_segments;
    let head_width = dim / num_heads;
    let scale = score_scale(dim, num_heads);

    let query = flatten::<B>(B::float_mul_scalar(query, scale.into()), num_heads); // [BS, H, E]
    let [key, value] = split::<B>(key_value, num_heads); // [BM, H, E]
    let scores = dot::<B>(B::float_select(query, 0, segment.clone()), key); // [BM, H, 1]

    // The maximum of every segment; the lowest finite value for segments without members.
    let (device, dtype) = (scores.device(), FloatDType::from(scores.dtype()));
    let per_segment = Shape::new([segments, num_heads, 1]);
    let lowest = B::float_full(per_segment.clone(), f64::from(f32::MIN).into(), &device, dtype);
    let maximum = B::float_select_assign(lowest, 0, segment.clone(), scores.clone(), IndexingUpdateOp::Max);
    let shifted = B::float_sub(scores, B::float_select(maximum, 0, segment.clone()));
    let exponential = B::float_exp(shifted);
    let zeros = B::float_zeros(per_segment, &device, dtype);
    let total = B::float_select_assign(zeros, 0, segment.clone(), exponential.clone(), IndexingUpdateOp::Add);
    // Every total that is read has a member with the maximal score, so that the total is at least one.
    let weights = B::float_div(exponential, B::float_select(total, 0, segment.clone()));

    let weighted = B::float_mul(value, weights.clone());
    let zeros = B::float_zeros(Shape::new([segments, num_heads, head_width]), &device, dtype);
    let output = B::float_select_assign(zeros, 0, segment, weighted, IndexingUpdateOp::Add);
    [B::float_reshape(output, Shape::new([batch, num_segments, dim])), weights]
}

/// Computes the gradients. With `g_i = dO[segment i]`: `dV_i = p_i g_i`, `dS_i = p_i (g_i v_i - rowsum(dO * O)[segment i])`,
/// `dK_i = s dS_i q[segment i]`, `dQ_s = s sum_i dS_i k_i`.
pub(crate) fn backward<B: Backend>(
    [query, key_value, output, weights, grad_output]: [FloatTensor<B>; 5],
    Clusters { segment, num_heads }: Clusters<IntTensor<B>>,
) -> [FloatTensor<B>; 2] {
    let query_shape = query.shape();
    let [_, num_members, _]: [usize; 3] = key_value.shape().dims();
    let [batch, num_segments, dim]: [usize; 3] = query_shape.dims();
    let head_width = dim / num_heads;
    let scale = score_scale(dim, num_heads);

    let grad_output = flatten::<B>(grad_output, num_heads); // [BS, H, E]
    let delta = dot::<B>(grad_output.clone(), flatten::<B>(output, num_heads)); // [BS, H, 1]
    let query = flatten::<B>(B::float_mul_scalar(query, scale.into()), num_heads);
    let [key, value] = split::<B>(key_value, num_heads);

    let gathered = B::float_select(grad_output, 0, segment.clone()); // [BM, H, E]
    let grad_value = B::float_mul(gathered.clone(), weights.clone());
    let grad_weights = B::float_sub(dot::<B>(gathered, value), B::float_select(delta, 0, segment.clone()));
    let grad_scores = B::float_mul(weights, grad_weights); // [BM, H, 1]
    let grad_key = B::float_mul(B::float_select(query, 0, segment.clone()), grad_scores.clone());
    let (device, dtype) = (key.device(), FloatDType::from(key.dtype()));
    let zeros = B::float_zeros(Shape::new([batch * num_segments, num_heads, head_width]), &device, dtype);
    let grad_query = B::float_select_assign(zeros, 0, segment, B::float_mul(key, grad_scores), IndexingUpdateOp::Add);
    let grad_query = B::float_mul_scalar(grad_query, scale.into());
    let members = [grad_key, grad_value].map(|x| B::float_reshape(x, Shape::new([batch, num_members, dim])));
    [B::float_reshape(grad_query, query_shape), B::float_cat(members.into(), 2)]
}

/// `[B, N, D] -> [BN, H, E]`
fn flatten<B: Backend>(x: FloatTensor<B>, num_heads: usize) -> FloatTensor<B> {
    let [batch, count, dim] = x.shape().dims();
    B::float_reshape(x, Shape::new([batch * count, num_heads, dim / num_heads]))
}

/// Dot product per head: `[N, H, E] -> [N, H, 1]`
fn dot<B: Backend>(a: FloatTensor<B>, b: FloatTensor<B>) -> FloatTensor<B> {
    B::float_sum_dim(B::float_mul(a, b), 2)
}
