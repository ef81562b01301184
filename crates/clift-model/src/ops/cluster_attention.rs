//! Attention of every centroid to the tokens of its cluster (paper, equation 2), linear in the number of tokens.
//!
//! A token is a key of one centroid only: there is one score per token and head, the softmax runs over segments, and no
//! `[centroids, tokens]` mask exists.

use burn::backend::Dispatch;
use burn::backend::tensor::{FloatTensor, IntTensor};
use burn::tensor::{Int, Tensor, assert_shape};

use crate::ops::autodiff::Differentiable;
use crate::ops::backends::dispatch::operations;
use crate::ops::composed::cluster_attention::ClusterInputs;
use crate::ops::kernels::Kernels;
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

operations! {
    /// The operation of [`cluster_attention`] on a backend.
    pub trait ClusterAttentionOps {
        fn cluster_attention(query, key_value; segment: IntTensor<Self>, num_heads: usize) = Clusters { segment, num_heads };
    }
}

/// The segment of every member, and the number of heads.
#[derive(Clone, Debug)]
struct Clusters<T> {
    segment: T,
    num_heads: usize,
}

impl<T: Clone> Clusters<T> {
    fn inputs<B: Kernels<IntTensorPrimitive = T>>(&self, [query, key_value]: [FloatTensor<B>; 2]) -> ClusterInputs<B> {
        ClusterInputs { query, key_value, segment: self.segment.clone(), num_heads: self.num_heads }
    }
}

impl<B: Kernels> Differentiable<B, 2> for Clusters<IntTensor<B>> {
    type Saved = (ClusterInputs<B>, [FloatTensor<B>; 2]);

    fn forward(&self, inputs: [FloatTensor<B>; 2]) -> FloatTensor<B> {
        let [output, _weights] = B::cluster_attention_forward(&self.inputs(inputs));
        output
    }

    fn forward_saving(&self, inputs: [FloatTensor<B>; 2]) -> (FloatTensor<B>, Self::Saved) {
        let inputs = self.inputs(inputs);
        let results = B::cluster_attention_forward(&inputs);
        (results[0].clone(), (inputs, results))
    }

    fn gradients(
        &self,
        (inputs, results): Self::Saved,
        grad_output: FloatTensor<B>,
        _needed: [bool; 2],
    ) -> [Option<FloatTensor<B>>; 2] {
        B::cluster_attention_backward(inputs, results, grad_output).map(Some)
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::{DType, Device};

    use super::*;
    use crate::testing::{assert_close, check_gradients, check_native, devices, random, to_vec};

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
        for device in devices() {
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
