//! Scaled dot-product attention as one operation with its own backward.
//!
//! Under autodiff, Burn's attention keeps about three score maps per head (13.5 GiB for one scene of 4,096 tokens). The
//! operations here keep inputs and output and compute the scores again in the backward, a chunk of queries at a time, so
//! that memory is linear in the number of tokens.

use burn::backend::Dispatch;
use burn::backend::tensor::FloatTensor;
use burn::tensor::{Tensor, assert_shape};

use crate::ops::autodiff::Differentiable;
use crate::ops::backends::dispatch::operations;
use crate::ops::composed::attention::{AttentionOutput, Qkv};
use crate::ops::kernels::{HeadConfig, Kernels, SavedQkv};
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

/// Computes attention of every query to every key, as [`self_sdpa`].
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
        fn self_sdpa(query_key_value; heads: HeadConfig) = Sdpa(heads);
        fn cross_sdpa(query, key_value; heads: HeadConfig) = Sdpa(heads);
    }
}

#[derive(Clone, Copy, Debug)]
struct Sdpa(HeadConfig);

/// Inputs and results of the forward pass.
#[derive(Clone, Debug)]
struct SavedAttention<T> {
    inputs: SavedQkv<T>,
    results: AttentionOutput<T>,
}

impl Sdpa {
    fn forward_saving<B: Kernels>(
        self,
        inputs: Qkv<FloatTensor<B>>,
    ) -> (FloatTensor<B>, SavedAttention<FloatTensor<B>>) {
        let (results, inputs) = B::attention_forward_saving(inputs, self.0);
        (results.output.clone(), SavedAttention { inputs, results })
    }

    fn gradients<B: Kernels>(
        self,
        saved: SavedAttention<FloatTensor<B>>,
        grad_output: FloatTensor<B>,
    ) -> Qkv<FloatTensor<B>> {
        B::attention_backward(saved.inputs.map(B::restore), saved.results, self.0, grad_output)
    }
}

impl<B: Kernels> Differentiable<B, 1> for Sdpa {
    type Saved = SavedAttention<FloatTensor<B>>;

    fn forward(&self, [packed]: [FloatTensor<B>; 1]) -> FloatTensor<B> {
        B::attention_forward(&Qkv::Packed(packed), self.0).output
    }

    fn forward_saving(&self, [packed]: [FloatTensor<B>; 1]) -> (FloatTensor<B>, Self::Saved) {
        Self::forward_saving::<B>(*self, Qkv::Packed(packed))
    }

    fn gradients(
        &self,
        saved: Self::Saved,
        grad_output: FloatTensor<B>,
        _needed: [bool; 1],
    ) -> [Option<FloatTensor<B>>; 1] {
        match Self::gradients::<B>(*self, saved, grad_output) {
            Qkv::Packed(grad) => [Some(grad)],
            Qkv::Separate { .. } => unreachable!("gradients have the layout of the inputs"),
        }
    }
}

impl<B: Kernels> Differentiable<B, 2> for Sdpa {
    type Saved = SavedAttention<FloatTensor<B>>;

    fn forward(&self, [query, key_value]: [FloatTensor<B>; 2]) -> FloatTensor<B> {
        B::attention_forward(&Qkv::Separate { query, key_value }, self.0).output
    }

    fn forward_saving(&self, [query, key_value]: [FloatTensor<B>; 2]) -> (FloatTensor<B>, Self::Saved) {
        Self::forward_saving::<B>(*self, Qkv::Separate { query, key_value })
    }

    fn gradients(
        &self,
        saved: Self::Saved,
        grad_output: FloatTensor<B>,
        _needed: [bool; 2],
    ) -> [Option<FloatTensor<B>>; 2] {
        match Self::gradients::<B>(*self, saved, grad_output) {
            Qkv::Separate { query, key_value } => [Some(query), Some(key_value)],
            Qkv::Packed(_) => unreachable!("gradients have the layout of the inputs"),
        }
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::{DType, Device};

    use super::*;
    use crate::ops::composed::attention::{MAX_SCORES, query_chunks};
    use crate::testing::{
        Fixture, assert_close, assert_finite, check_equal, check_gradients, check_native, devices,
        output_and_gradients, random,
    };

    fn sdpa(query: Tensor<3>, key: Tensor<3>, value: Tensor<3>, num_heads: usize) -> Tensor<3> {
        cross_sdpa(query, Tensor::cat(vec![key, value], 2), num_heads)
    }

    fn plain(query: Tensor<3>, key: Tensor<3>, value: Tensor<3>, num_heads: usize) -> Tensor<3> {
        let [batch, num_queries, dim] = query.dims();
        let num_keys = key.dims()[1];
        let head_width = dim / num_heads;
        let heads = |x: Tensor<3>, count: usize| x.reshape([batch, count, num_heads, head_width]).swap_dims(1, 2);
        let scores = heads(query, num_queries).matmul(heads(key, num_keys).swap_dims(2, 3));
        let weights = burn::tensor::activation::softmax(scores.mul_scalar(1.0 / (head_width as f64).sqrt()), 3);
        weights.matmul(heads(value, num_keys)).swap_dims(1, 2).reshape([batch, num_queries, dim])
    }

    #[test]
    fn output_and_gradients_equal_pytorch() {
        let fixture = Fixture::open("sdpa");
        for device in devices() {
            let read = |name: &str| fixture.tensor::<3>(name, &device);
            let inputs = ["q", "k", "v"].map(|name| read(&format!("input.{name}")));
            let (output, grads) = output_and_gradients(inputs, read("input.cotangent"), |[q, k, v]| sdpa(q, k, v, 4));
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
            let inputs = [random([2, 5, 8], 1, &device), random([2, 7, 8], 2, &device), random([2, 7, 8], 3, &device)];
            check_gradients(inputs, |[q, k, v]| sdpa(q, k, v, 2), 1e-6);
        }
    }

    #[test]
    fn one_and_two_chunks_equal_plain_autodiff_in_f64() {
        assert_eq!(query_chunks(1, 8, 4096, 4096).len(), 8);
        assert_eq!(query_chunks(1, 1, 3, MAX_SCORES * 2), [0..1, 1..2, 2..3]);
        // 2 x 64 heads x 512 x 512 = 2^25 scores. All tensors are f64 and take the composed operation.
        let device = Device::flex();
        for (num_queries, num_keys, dim, num_heads, num_chunks) in [(5, 7, 8, 4, 1), (512, 512, 64, 64, 2)] {
            assert_eq!(query_chunks(2, num_heads, num_queries, num_keys).len(), num_chunks);
            let inputs =
                [(num_queries, 1), (num_keys, 2), (num_keys, 3)].map(|(n, seed)| random([2, n, dim], seed, &device));
            let cotangent = random([2, num_queries, dim], 4, &device);
            let f = |[q, k, v]: [Tensor<3>; 3]| sdpa(q, k, v, num_heads);
            check_equal(inputs, cotangent, f, |[q, k, v]| plain(q, k, v, num_heads), 1e-12);
        }
    }

    #[test]
    fn packed_inputs_equal_separate_inputs() {
        for device in devices() {
            let (packed, cotangent) = (random([2, 5, 24], 1, &device), random([2, 5, 8], 2, &device));
            let separate = [0, 1, 2].map(|part| packed.clone().narrow(2, 8 * part, 8));
            let (output, [grad]) = output_and_gradients([packed], cotangent.clone(), |[packed]| self_sdpa(packed, 2));
            let (expected, grads) = output_and_gradients(separate, cotangent, |[q, k, v]| sdpa(q, k, v, 2));
            assert_close(&output, &expected, 1e-12);
            assert_close(&grad, &Tensor::cat(grads.into(), 2), 1e-12);
        }
    }

    #[test]
    fn native_kernels_equal_the_composed_operation_at_odd_shapes() {
        type Attend = fn([Tensor<3>; 2]) -> Tensor<3>;
        let device = Device::flex();
        let cases: [([usize; 4], Attend); 5] = [
            ([2, 1, 7, 36], |[q, kv]| cross_sdpa(q, kv, 3)),
            ([1, 9, 1, 24], |[q, kv]| cross_sdpa(q, kv, 2)),
            ([1, 101, 67, 192], |[q, kv]| cross_sdpa(q, kv, 2)),
            ([2, 35, 35, 36], |[_, qkv]| self_sdpa(qkv, 3)),
            ([1, 130, 130, 96], |[_, qkv]| self_sdpa(qkv, 1)),
        ];
        for (i, ([batch, queries, keys, dim], attend)) in cases.into_iter().enumerate() {
            let parts = if i < 3 { 2 } else { 3 };
            let shapes = [[batch, queries, dim], [batch, keys, parts * dim], [batch, queries, dim]];
            let [q, kv, cotangent] = [0, 1, 2].map(|i| random(shapes[i], i as u64, &device));
            check_native([q, kv], cotangent, attend, 1e-5);
        }
    }

    #[test]
    fn extreme_logits_stay_finite_and_select_the_largest() {
        for device in devices() {
            let rows = |values: &[f32]| {
                let rows = values.iter().map(|&value| Tensor::<3>::full([1, 1, 4], value, &device));
                Tensor::cat(rows.collect(), 1)
            };
            // Scores of 20,000 and -20,000.
            let inputs = [rows(&[200.0, 200.0]), rows(&[50.0, -50.0]), rows(&[1.0, 0.0])];
            let ones = rows(&[1.0, 1.0]);
            let (output, grads) = output_and_gradients(inputs, ones.clone(), |[q, k, v]| sdpa(q, k, v, 1));
            assert_close(&output, &ones, 0.0);
            assert_finite(grads);
        }
    }

    #[test]
    fn one_key_gives_its_value_and_equal_keys_their_mean() {
        for device in devices() {
            let values = random([2, 5, 8], 1, &device).cast(DType::F32);
            let query = values.clone().narrow(1, 0, 3);
            let value = values.clone().narrow(1, 4, 1);
            assert_close(&sdpa(query.clone(), value.clone(), value.clone(), 2), &value.expand([2, 3, 8]), 1e-6);
            let output = sdpa(query, values.ones_like(), values.clone(), 2);
            assert_close(&output, &values.mean_dim(1).expand([2, 3, 8]), 1e-6);
        }
    }
}
