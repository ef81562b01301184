//! Attention of every centroid to the tokens of its cluster (paper, equation 2), linear in the number of tokens.
//!
//! A token is a key of one centroid only: there is one score per token and head, the softmax runs over segments, and no
//! `[centroids, tokens]` mask exists.

use burn::backend::Dispatch;
use burn::backend::tensor::{FloatTensor, IntTensor};
use burn::tensor::{Int, Tensor, assert_shape};

use crate::ops::autodiff::{Differentiable, InputGrads};
use crate::ops::backends::dispatch::operations;
use crate::ops::composed::cluster_attention::Clusters;
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

impl<B: Kernels> Differentiable<B, 2> for Clusters<IntTensor<B>> {
    type Saved = [FloatTensor<B>; 4];

    fn forward_saving(&self, inputs: [FloatTensor<B>; 2]) -> (FloatTensor<B>, Self::Saved) {
        let [query, key_value] = inputs.clone();
        let [output, weights] = B::cluster_attention_forward(inputs, self.clone());
        (output.clone(), [query, key_value, output, weights])
    }

    fn gradients(
        &self,
        [query, key_value, output, weights]: Self::Saved,
        grad: FloatTensor<B>,
        _: [bool; 2],
    ) -> InputGrads<B, 2> {
        B::cluster_attention_backward([query, key_value, output, weights, grad], self.clone()).map(Some)
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::Device;

    use super::*;
    use crate::testing::{check_gradients, check_native, devices, random};

    #[test]
    fn gradients_equal_central_differences_in_f64() {
        // Seven members and four segments per scene, two scenes: unequal sizes, one singleton, one empty segment.
        const SEGMENTS: [i64; 14] = [0, 0, 2, 0, 1, 2, 0, 5, 7, 7, 5, 4, 5, 4];
        for device in devices() {
            let segments = Tensor::from_ints(SEGMENTS, &device);
            let inputs = [([2, 4, 8], 1), ([2, 7, 16], 2)].map(|(shape, seed)| random(shape, seed, &device));
            check_gradients(inputs, |[q, kv]| cluster_attention(q, kv, segments.clone(), 2), 1e-6);
        }
    }

    #[test]
    fn native_kernels_equal_f64_at_odd_shapes() {
        let device = Device::flex();
        for ([num_segments, heads, width], members) in
            [([1, 1, 12], 3), ([37, 2, 12], 200), ([19, 3, 96], 77), ([5, 1, 5], 40)]
        {
            // Of unequal size, some empty, members in mixed order; the second scene has them in other order.
            let segment = |i: usize| i * i * 7 % (num_segments + 2) % num_segments;
            let second = (0..members).map(|i| num_segments + segment(i + 1));
            let all: Vec<i64> = (0..members).map(segment).chain(second).map(|segment| segment as i64).collect();
            let segments = Tensor::<1, Int>::from_ints(all.as_slice(), &device);
            let shapes = [([2, num_segments, heads * width], 1), ([2, members, 2 * heads * width], 2)];
            let inputs = shapes.map(|(shape, seed)| random(shape, seed, &device));
            check_native(inputs, |[q, kv]| cluster_attention(q, kv, segments.clone(), heads), 1e-5);
        }
    }
}
