//! Attention of every centroid to the tokens of its cluster (paper, equation 2), linear in the number of tokens.
//!
//! A token is a key of one centroid only: there is one score per token and head, the softmax runs over segments, and no
//! `[centroids, tokens]` mask exists.
// B scenes, S centroids, M members, D width, H heads, E = D/H width of a head

use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::tensor::{FloatTensor, IndexingUpdateOp, IntTensor};
use burn::backend::{Autodiff, Backend, Dispatch, TensorMetadata, backend_extension};
use burn::tensor::{FloatDType, Int, Shape, Slice, Tensor, assert_shape};

use crate::ops::autodiff::register;
use crate::ops::mac_counter;

/// Computes attention of every centroid to its members: `o_s = sum_i softmax_i(q_s k_i / sqrt(head width)) v_i`
/// over the members `i` of segment `s`; zeros for a centroid without members.
///
/// The gradient is exact and of first order. Scores are shifted by the maximum of their segment.
///
/// # Shapes
/// - `query`: `[batch, num_segments, dim]`
/// - `key_value`: `[batch, num_members, 2 dim]`, keys and values side by side
/// - `segment`: `[batch * num_members]`, `scene * num_segments + cluster` of every member
/// - returns `[batch, num_segments, dim]`
pub fn cluster_attention(
    query: Tensor<3>,
    key_value: Tensor<3>,
    segment: Tensor<1, Int>,
    num_heads: usize,
) -> Tensor<3> {
    let [batch, _num_segments, dim] = query.dims();
    let [_, num_members, _] = key_value.dims();
    assert_shape!(key_value, [batch, num_members, 2 * dim]);
    assert_shape!(segment, [batch * num_members]);
    assert!(dim.is_multiple_of(num_heads), "{num_heads} heads do not divide a width of {dim}");
    mac_counter::add_attention(batch * num_members, dim);
    Tensor::from_dispatch(<Dispatch as ClusterAttentionOps>::cluster_attention(
        query.into_dispatch(),
        key_value.into_dispatch(),
        segment.into_dispatch(),
        num_heads,
    ))
}

/// The operation of [`cluster_attention`] on a backend.
#[backend_extension(Flex, NdArray: cfg(feature = "ndarray"), Cube: cfg(feature = "wgpu"), Autodiff)]
pub trait ClusterAttentionOps: Backend {
    fn cluster_attention(
        query: FloatTensor<Self>,
        key_value: FloatTensor<Self>,
        segment: IntTensor<Self>,
        num_heads: usize,
    ) -> FloatTensor<Self>;
}

/// The operation and its gradients on a backend. The default implementations run on every backend.
pub trait ClusterAttentionKernels: Backend {
    /// Computes the output `[B, S, D]` and the weights `[BM, H, 1]`.
    fn attend_clusters(inputs: &ClusterInputs<Self>) -> [FloatTensor<Self>; 2] {
        composed_forward::<Self>(inputs)
    }

    /// Computes the gradients of `query` and `key_value` from the saved results and the gradient of the output.
    fn attend_clusters_backward(
        inputs: ClusterInputs<Self>,
        results: [FloatTensor<Self>; 2],
        grad_output: FloatTensor<Self>,
    ) -> [FloatTensor<Self>; 2] {
        composed_backward::<Self>(inputs, results, grad_output)
    }
}

#[derive(Clone, Debug)]
pub struct ClusterInputs<B: Backend> {
    pub(crate) query: FloatTensor<B>,
    pub(crate) key_value: FloatTensor<B>,
    pub(crate) segment: IntTensor<B>,
    pub(crate) num_heads: usize,
}

impl<B: ClusterAttentionKernels> ClusterAttentionOps for B {
    fn cluster_attention(
        query: FloatTensor<Self>,
        key_value: FloatTensor<Self>,
        segment: IntTensor<Self>,
        num_heads: usize,
    ) -> FloatTensor<Self> {
        let [output, _] = Self::attend_clusters(&ClusterInputs { query, key_value, segment, num_heads });
        output
    }
}

#[cfg(feature = "ndarray")]
impl ClusterAttentionKernels for burn::backend::NdArray {}
#[cfg(feature = "wgpu")]
impl ClusterAttentionKernels for burn::backend::Cube {}

impl<B: ClusterAttentionKernels, C: CheckpointStrategy> ClusterAttentionOps for Autodiff<B, C> {
    fn cluster_attention(
        query: FloatTensor<Self>,
        key_value: FloatTensor<Self>,
        segment: IntTensor<Self>,
        num_heads: usize,
    ) -> FloatTensor<Self> {
        let ((query, query_node), (key_value, key_value_node)) = (query.into_parts(), key_value.into_parts());
        match ClusterBackward.prepare::<C>([query_node, key_value_node]).compute_bound().stateful() {
            OpsKind::Tracked(prep) => {
                let inputs = ClusterInputs::<B> { query, key_value, segment, num_heads };
                let results = B::attend_clusters(&inputs);
                let output = results[0].clone();
                prep.finish((inputs, results), output)
            }
            OpsKind::UnTracked(prep) => prep.finish(B::cluster_attention(query, key_value, segment, num_heads)),
        }
    }
}

#[derive(Debug)]
struct ClusterBackward;

impl<B: ClusterAttentionKernels> Backward<B, 2> for ClusterBackward {
    type State = (ClusterInputs<B>, [FloatTensor<B>; 2]);

    fn backward(self, ops: Ops<Self::State, 2>, grads: &mut Gradients, _checkpointer: &mut Checkpointer) {
        register::<B, _, 2>(ops, grads, |(inputs, results), grad_output, _| {
            B::attend_clusters_backward(inputs, results, grad_output).map(Some)
        });
    }
}

/// Splits into keys and values, each `[BM, H, E]`.
fn split<B: Backend>(key_value: FloatTensor<B>, num_heads: usize) -> [FloatTensor<B>; 2] {
    let [batch, count, width] = key_value.shape().dims();
    let dim = width / 2;
    [0..dim, dim..width].map(|columns| {
        flatten::<B>(B::float_slice(key_value.clone(), &[0..batch, 0..count, columns].map(Slice::from)), num_heads)
    })
}

pub(crate) fn composed_forward<B: Backend>(inputs: &ClusterInputs<B>) -> [FloatTensor<B>; 2] {
    let ClusterInputs { query, key_value, segment, num_heads } = inputs.clone();
    let [batch, num_segments, dim] = query.shape().dims();
    let segments = batch * num_segments;
    let head_width = dim / num_heads;
    let scale = 1.0 / (head_width as f64).sqrt();

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
pub(crate) fn composed_backward<B: Backend>(
    inputs: ClusterInputs<B>,
    [output, weights]: [FloatTensor<B>; 2],
    grad_output: FloatTensor<B>,
) -> [FloatTensor<B>; 2] {
    let ClusterInputs { query, key_value, segment, num_heads } = inputs;
    let query_shape = query.shape();
    let [_, num_members, _]: [usize; 3] = key_value.shape().dims();
    let [batch, num_segments, dim]: [usize; 3] = query_shape.dims();
    let head_width = dim / num_heads;
    let scale = 1.0 / (head_width as f64).sqrt();

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

#[cfg(test)]
mod tests {
    use burn::tensor::{DType, Device};

    use super::*;
    use crate::testing::{assert_close, check_gradients, check_native, cpu_devices, devices, random, to_vec};

    fn cluster_attention(
        query: Tensor<3>,
        key: Tensor<3>,
        value: Tensor<3>,
        segment: Tensor<1, Int>,
        num_heads: usize,
    ) -> Tensor<3> {
        super::cluster_attention(query, Tensor::cat(vec![key, value], 2), segment, num_heads)
    }

    /// Seven members and four segments per scene, two scenes: unequal sizes, one singleton, one empty segment.
    const SEGMENTS: [i64; 14] = [0, 0, 2, 0, 1, 2, 0, 5, 7, 7, 5, 4, 5, 4];

    fn segments(device: &Device) -> Tensor<1, Int> {
        Tensor::from_ints(SEGMENTS, device)
    }

    fn inputs(device: &Device) -> [Tensor<3>; 3] {
        [(4, 1), (7, 2), (7, 3)].map(|(count, seed)| random([2, count, 8], seed, device))
    }

    fn attend([q, k, v]: [Tensor<3>; 3]) -> Tensor<3> {
        let segments = segments(&q.device());
        cluster_attention(q, k, v, segments, 2)
    }

    #[test]
    fn gradients_equal_central_differences_in_f64() {
        for device in cpu_devices() {
            check_gradients(inputs(&device), attend, 1e-6);
        }
    }

    #[test]
    fn native_kernels_equal_the_composed_operation() {
        let device = Device::flex();
        check_native(inputs(&device), random([2, 4, 8], 4, &device), attend, 1e-5);
    }

    #[test]
    fn a_segment_without_members_gives_zeros() {
        for device in devices() {
            let output = to_vec(attend(inputs(&device).map(|x| x.cast(DType::F32))));
            assert!(output[3 * 8..4 * 8].iter().all(|&value| value == 0.0), "segment 3 has no members");
        }
    }

    #[test]
    fn extreme_logits_of_a_cluster_leave_others_unchanged() {
        for device in devices() {
            let q = Tensor::<3>::from_floats([[[1e4, 0.0], [1e-3, 0.0]]], &device);
            let k = Tensor::<3>::from_floats([[[1.0, 0.0], [-1.0, 0.0], [1.0, 0.0], [1.0, 0.0]]], &device);
            let v = Tensor::<3>::from_floats([[[1.0, 2.0], [9.0, 9.0], [3.0, 4.0], [5.0, 6.0]]], &device);
            let output = cluster_attention(q, k, v, Tensor::from_ints([0, 0, 1, 1], &device), 1);
            assert_close(&output, &Tensor::from_floats([[[1.0, 2.0], [4.0, 5.0]]], &device), 1e-6);
        }
    }
}
