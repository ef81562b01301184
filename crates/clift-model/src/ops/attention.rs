//! Scaled dot-product attention as one operation with its own backward.
//!
//! Under autodiff, Burn's attention keeps about three score maps per head (13.5 GiB for one scene of 4,096 tokens). The
//! operations here keep inputs and output and compute the scores again in the backward, a chunk of queries at a time, so
//! that memory is linear in the number of tokens.

use burn::backend::Dispatch;
use burn::backend::tensor::FloatTensor;
use burn::tensor::{Tensor, assert_shape};

use crate::ops::autodiff::{Differentiable, InputGrads};
use crate::ops::backends::dispatch::operations;
use crate::ops::kernels::{AttentionResults, HeadConfig, Kernels, SavedTensor};
use crate::ops::mac_counter;

/// Computes attention among the tokens of a scene, `softmax(q k^T / sqrt(head width)) v`, unmasked.
///
/// The gradient is exact and of first order. Scores are shifted by the maximum of their row, so that finite inputs give
/// finite outputs for logits up to 1e9.
///
/// # Shapes
/// - `query_key_value`: `[batch, count, 3 dim]`, queries, keys and values side by side; head `h` starts at column
///   `h * dim / num_heads` of each
/// - returns `[batch, count, dim]`
pub fn self_sdpa(query_key_value: Tensor<3>, num_heads: usize) -> Tensor<3> {
    let [batch, count, packed] = query_key_value.dims();
    assert!(packed.is_multiple_of(3 * num_heads), "{num_heads} heads do not divide a third of {packed}");
    mac_counter::add_attention(batch * count * count, packed / 3);
    Tensor::from_dispatch(<Dispatch as AttentionOps>::self_sdpa(
        query_key_value.into_dispatch(),
        HeadConfig::now(num_heads),
    ))
}

/// Computes attention of every query to every key, as `self_sdpa`.
///
/// # Shapes
/// - `query`: `[batch, num_queries, dim]`, `key_value`: `[batch, num_keys, 2 dim]`, keys and values side by side
/// - returns `[batch, num_queries, dim]`
pub fn cross_sdpa(query: Tensor<3>, key_value: Tensor<3>, num_heads: usize) -> Tensor<3> {
    let [batch, num_queries, dim] = query.dims();
    let [_, num_keys, _] = key_value.dims();
    assert_shape!(key_value, [batch, num_keys, 2 * dim]);
    assert!(dim.is_multiple_of(num_heads), "{num_heads} heads do not divide a width of {dim}");
    mac_counter::add_attention(batch * num_queries * num_keys, dim);
    let (query, key_value) = (query.into_dispatch(), key_value.into_dispatch());
    Tensor::from_dispatch(<Dispatch as AttentionOps>::cross_sdpa(query, key_value, HeadConfig::now(num_heads)))
}

operations! {
    /// The operations of [`self_sdpa`] and [`cross_sdpa`] on a backend.
    pub trait AttentionOps {
        fn self_sdpa(query_key_value; heads: HeadConfig) = heads;
        fn cross_sdpa(query, key_value; heads: HeadConfig) = heads;
    }
}

impl<B: Kernels, const N: usize> Differentiable<B, N> for HeadConfig {
    type Saved = ([SavedTensor<FloatTensor<B>>; N], AttentionResults<FloatTensor<B>>);

    fn forward(&self, inputs: [FloatTensor<B>; N]) -> FloatTensor<B> {
        B::attention_forward(&inputs, *self).0
    }

    fn forward_saving(&self, inputs: [FloatTensor<B>; N]) -> (FloatTensor<B>, Self::Saved) {
        let (results, inputs) = B::attention_forward_saving(inputs, *self);
        (results.0.clone(), (inputs, results))
    }

    fn gradients(&self, (inputs, results): Self::Saved, grad: FloatTensor<B>, _: [bool; N]) -> InputGrads<B, N> {
        B::attention_backward(inputs.map(B::restore), results, *self, grad).map(Some)
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::Device;

    use super::*;
    use crate::ops::composed::attention::{MAX_SCORES, query_chunks};
    use crate::ops::precision::Precision;
    use crate::testing::{Fixture, assert_close, check_gradients, check_native, devices, output_and_gradients, random};

    fn sdpa([query, key, value]: [Tensor<3>; 3], num_heads: usize) -> Tensor<3> {
        cross_sdpa(query, Tensor::cat(vec![key, value], 2), num_heads)
    }

    #[test]
    fn output_and_gradients_equal_pytorch() {
        let fixture = Fixture::open("sdpa");
        for device in devices() {
            let read = |name: &str| fixture.tensor::<3>(name, &device);
            let inputs = ["q", "k", "v"].map(|name| read(&format!("input.{name}")));
            let (output, grads) = output_and_gradients(inputs, read("input.cotangent"), |inputs| sdpa(inputs, 4));
            // f32 sums of 11 terms against f64.
            assert_close(&output, &read("output.output"), 2e-6);
            for (name, grad) in ["q", "k", "v"].iter().zip(&grads) {
                assert_close(grad, &read(&format!("grad.input.{name}")), 5e-6);
            }
        }
    }

    #[test]
    fn gradients_equal_central_differences_in_f64() {
        for device in devices() {
            let [q, kv, packed] =
                [([2, 5, 8], 1), ([2, 7, 16], 2), ([2, 5, 24], 3)].map(|(shape, seed)| random(shape, seed, &device));
            check_gradients([q, kv], |[q, kv]| cross_sdpa(q, kv, 2), 1e-6);
            check_gradients([packed], |[packed]| self_sdpa(packed, 2), 1e-6);
        }
    }

    /// Compares cross-attention with f64, and self-attention if there are as many keys as queries.
    fn check([batch, num_queries, num_keys, num_heads, head_width]: [usize; 5], spread: f64, tolerance: f64) {
        let dim = num_heads * head_width;
        let shapes = [([batch, num_queries, dim], 1), ([batch, num_keys, 2 * dim], 2)];
        let [q, kv] = shapes.map(|(shape, seed)| random(shape, seed, &Device::flex()));
        let inputs = [q * spread, kv];
        if num_queries == num_keys {
            check_native([Tensor::cat(inputs.to_vec(), 2)], |[packed]| self_sdpa(packed, num_heads), tolerance);
        }
        check_native(inputs, |[q, kv]| cross_sdpa(q, kv, num_heads), tolerance);
    }

    #[test]
    fn native_kernels_equal_f64_at_odd_shapes() {
        // bf16 has 8 bits of significand; errors of scores grow with the scores.
        for (precision, tolerance) in [(Precision::F32, 1e-5), (Precision::Bf16, 1e-2)] {
            let _scope = precision.scope();
            for (sizes, spread) in [
                ([1, 1, 7, 1, 12], 1.0),
                ([2, 5, 1, 2, 12], 1.0),
                ([1, 97, 601, 2, 12], 3.0),
                ([2, 131, 67, 3, 96], 1.0),
                ([1, 13, 1031, 1, 96], 2.0),
                ([1, 200, 33, 1, 16], 1.0),
                ([1, 24, 48, 2, 40], 1.0),
                ([2, 51, 51, 2, 20], 1.0),
            ] {
                check(sizes, spread, tolerance * if precision == Precision::Bf16 { spread } else { 1.0 });
            }
        }
    }

    #[test]
    fn two_chunks_of_queries_equal_native_kernels() {
        assert_eq!(query_chunks(1, 8, 4096, 4096).len(), 8);
        assert_eq!(query_chunks(1, 1, 3, MAX_SCORES * 2), [0..1, 1..2, 2..3]);
        // 64 heads x 1,024 keys take 256 queries at a time.
        assert_eq!(query_chunks(1, 64, 257, 1024), [0..256, 256..257]);
        check([1, 257, 1024, 64, 1], 1.0, 1e-5);
    }
}
