//! Scaled dot-product attention as one operation with its own backward, and the layers made of it.
//!
//! Under autodiff Burn's own attention keeps about three score maps per head (13.5 GiB for one
//! scene of 4,096 tokens). The operations here keep their inputs and their output, and compute the scores
//! again in the backward, a chunk of queries at a time: memory is linear in the number of tokens.
#![expect(deprecated, reason = "upstream retires ndarray in favour of flex; it stays as an independent check")]
// B scenes, Q queries, K keys, D width, H heads, E = D/H width of a head

use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, Dispatch, Flex, NdArray, backend_extension};
use burn::tensor::{Tensor, assert_shape};

use crate::ops::attention::backends::AttentionKernels;
use crate::ops::attention::composed::{AttentionOutput, HeadConfig, Qkv};
use crate::ops::autodiff::register;
use crate::ops::mac_counter;

/// Attention among the tokens of a scene, `softmax(q k^T / sqrt(head width)) v`, unmasked.
///
/// Its gradient is exact and first order. Scores are shifted by their row's maximum, so finite
/// inputs give finite outputs whatever the size of the logits.
///
/// # Shapes
/// - `query_key_value`: `[batch, count, 3 dim]`, the three side by side; head `h` is columns
///   `h * dim / num_heads ..` of each
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

/// Attention of every query to every key, like [`self_sdpa`].
///
/// # Shapes
/// - `query`: `[batch, num_queries, dim]`, `key_value`: `[batch, num_keys, 2 dim]`, the two side by side
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

/// The operations behind [`self_sdpa`] and [`cross_sdpa`] on a device.
#[backend_extension(Flex, NdArray, Cube: cfg(feature = "wgpu"), Autodiff)]
pub trait AttentionOps: Backend {
    /// See [`self_sdpa`].
    fn self_sdpa(query_key_value: FloatTensor<Self>, heads: HeadConfig) -> FloatTensor<Self>;

    /// See [`cross_sdpa`].
    fn cross_sdpa(query: FloatTensor<Self>, key_value: FloatTensor<Self>, heads: HeadConfig) -> FloatTensor<Self>;
}

macro_rules! attention_ops {
    ($backend:ty) => {
        impl AttentionOps for $backend {
            fn self_sdpa(query_key_value: FloatTensor<Self>, heads: HeadConfig) -> FloatTensor<Self> {
                Self::attend(&Qkv::Packed(query_key_value), heads).output
            }

            fn cross_sdpa(
                query: FloatTensor<Self>,
                key_value: FloatTensor<Self>,
                heads: HeadConfig,
            ) -> FloatTensor<Self> {
                Self::attend(&Qkv::Separate { query, key_value }, heads).output
            }
        }
    };
}
attention_ops!(Flex);
attention_ops!(NdArray);
#[cfg(feature = "wgpu")]
attention_ops!(burn::backend::Cube);

impl<B: AttentionOps + AttentionKernels, C: CheckpointStrategy> AttentionOps for Autodiff<B, C> {
    fn self_sdpa(query_key_value: FloatTensor<Self>, heads: HeadConfig) -> FloatTensor<Self> {
        let (packed, node) = query_key_value.into_parts();
        match SdpaBackward.prepare::<C>([node]).compute_bound().stateful() {
            OpsKind::Tracked(prep) => {
                let state = attend::<B>(Qkv::Packed(packed), heads);
                let output = state.attended.output.clone();
                prep.finish(state, output)
            }
            OpsKind::UnTracked(prep) => prep.finish(B::self_sdpa(packed, heads)),
        }
    }

    fn cross_sdpa(query: FloatTensor<Self>, key_value: FloatTensor<Self>, heads: HeadConfig) -> FloatTensor<Self> {
        let ((query, query_node), (key_value, key_value_node)) = (query.into_parts(), key_value.into_parts());
        match SdpaBackward.prepare::<C>([query_node, key_value_node]).compute_bound().stateful() {
            OpsKind::Tracked(prep) => {
                let state = attend::<B>(Qkv::Separate { query, key_value }, heads);
                let output = state.attended.output.clone();
                prep.finish(state, output)
            }
            OpsKind::UnTracked(prep) => prep.finish(B::cross_sdpa(query, key_value, heads)),
        }
    }
}

#[derive(Debug)]
struct SdpaBackward;

#[derive(Clone, Debug)]
pub(crate) struct SdpaState<T> {
    inputs: Qkv<T>,
    attended: AttentionOutput<T>,
    heads: HeadConfig,
}

impl<T> SdpaState<T> {
    /// The gradients of the inputs.
    fn backward<B: AttentionKernels<FloatTensorPrimitive = T>>(self, grad_output: T) -> Qkv<T> {
        B::attend_backward(self.inputs, self.attended, self.heads, grad_output)
    }
}

pub(crate) fn attend<B: AttentionKernels>(inputs: Qkv<FloatTensor<B>>, heads: HeadConfig) -> SdpaState<FloatTensor<B>> {
    SdpaState { attended: B::attend(&inputs, heads), inputs, heads }
}

impl<B: AttentionKernels> Backward<B, 1> for SdpaBackward {
    type State = SdpaState<FloatTensor<B>>;

    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _checkpointer: &mut Checkpointer) {
        register::<B, _, 1>(ops, grads, |state, grad_output, _| match state.backward::<B>(grad_output) {
            Qkv::Packed(grad) => [Some(grad)],
            Qkv::Separate { .. } => unreachable!("gradients come as the inputs did"),
        });
    }
}

impl<B: AttentionKernels> Backward<B, 2> for SdpaBackward {
    type State = SdpaState<FloatTensor<B>>;

    fn backward(self, ops: Ops<Self::State, 2>, grads: &mut Gradients, _checkpointer: &mut Checkpointer) {
        register::<B, _, 2>(ops, grads, |state, grad_output, _| match state.backward::<B>(grad_output) {
            Qkv::Separate { query, key_value } => [Some(query), Some(key_value)],
            Qkv::Packed(_) => unreachable!("gradients come as the inputs did"),
        });
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::{DType, Device, Distribution};

    use super::*;
    use crate::ops::attention::composed::{MAX_SCORES, query_chunks};
    use crate::testing::{Fixture, assert_close, check_gradients, cpu_devices, devices, random, relative_error};

    fn sdpa(query: Tensor<3>, key: Tensor<3>, value: Tensor<3>, num_heads: usize) -> Tensor<3> {
        cross_sdpa(query, Tensor::cat(vec![key, value], 2), num_heads)
    }

    /// Attention from Burn's own differentiable operations: the plain reference.
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
    fn output_and_gradients_equal_pytorchs() {
        let fixture = Fixture::open("sdpa");
        for device in devices() {
            let device = device.autodiff();
            let [q, k, v] =
                ["q", "k", "v"].map(|name| fixture.tensor::<3>(&format!("input.{name}"), &device).require_grad());
            let cotangent = fixture.tensor::<3>("input.cotangent", &device);
            let output = sdpa(q.clone(), k.clone(), v.clone(), 4);
            // f32 sums of 11 terms against f64.
            assert_close(&output.clone().inner(), &fixture.tensor::<3>("output.output", &device).inner(), 2e-6);
            let grads = (output * cotangent).sum().backward();
            for (name, input) in [("q", q), ("k", k), ("v", v)] {
                let expected = fixture.tensor::<3>(&format!("grad.input.{name}"), &device).inner();
                assert_close(&input.grad(&grads).expect("tracked"), &expected, 5e-6);
            }
        }
    }

    #[test]
    fn gradients_equal_central_differences_in_f64() {
        for device in cpu_devices() {
            let inputs = [random([2, 5, 8], 1, &device), random([2, 7, 8], 2, &device), random([2, 7, 8], 3, &device)];
            check_gradients(inputs, |[q, k, v]| sdpa(q, k, v, 2), 1e-6);
        }
    }

    #[test]
    fn gradients_equal_plain_autodiff_in_f64() {
        for device in cpu_devices() {
            let device = device.autodiff();
            let make = |seed, count| random([2, count, 8], seed, &device).require_grad();
            let gradients = |attend: &dyn Fn(Tensor<3>, Tensor<3>, Tensor<3>) -> Tensor<3>| {
                let (q, k, v) = (make(1, 5), make(2, 7), make(3, 7));
                let cotangent = random([2, 5, 8], 4, &device);
                let grads = (attend(q.clone(), k.clone(), v.clone()) * cotangent).sum().backward();
                [q, k, v].map(|input| input.grad(&grads).expect("tracked"))
            };
            let ours = gradients(&|q, k, v| sdpa(q, k, v, 4));
            let reference = gradients(&|q, k, v| plain(q, k, v, 4));
            for (a, b) in ours.iter().zip(&reference) {
                assert_close(a, b, 1e-12);
            }
        }
    }

    #[test]
    fn packed_inputs_give_what_separate_ones_give() {
        for device in cpu_devices() {
            let device = device.autodiff();
            let packed = random([2, 5, 24], 1, &device).require_grad();
            let part = |i: usize| packed.clone().narrow(2, 8 * i, 8).detach().require_grad();
            let separate = [part(0), part(1), part(2)];
            let cotangent = random([2, 5, 8], 2, &device);
            let together = self_sdpa(packed.clone(), 2);
            let [q, k, v] = separate.clone();
            let apart = sdpa(q, k, v, 2);
            assert_close(&together.clone().inner(), &apart.clone().inner(), 1e-12);
            let grad = packed.grad(&(together * cotangent.clone()).sum().backward()).expect("tracked");
            let grads = (apart * cotangent).sum().backward();
            let expected = separate.iter().map(|input| input.grad(&grads).expect("tracked")).collect();
            assert_close(&grad, &Tensor::cat(expected, 2), 1e-12);
        }
    }

    type Attend = fn([Tensor<3>; 2]) -> Tensor<3>;

    /// Output and gradients of the inputs.
    fn results(inputs: [Tensor<3>; 2], cotangent: Tensor<3>, attend: Attend) -> [Tensor<3>; 3] {
        let inputs = inputs.map(|input| input.autodiff().require_grad());
        let output = attend(inputs.clone());
        let grads = (output.clone() * cotangent.autodiff()).sum().backward();
        let [a, b] = inputs.map(|input| input.grad(&grads).unwrap_or_else(|| input.inner().zeros_like()));
        [output.inner(), a, b].map(|x| x.cast(DType::F64))
    }

    #[test]
    fn native_kernels_equal_the_composed_operation_in_f64_at_odd_shapes() {
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
            let [q, kv, cotangent] = [0, 1, 2].map(|i| random(shapes[i], i as u64, &device).cast(DType::F32));
            let native = results([q.clone(), kv.clone()], cotangent.clone(), attend);
            let reference = results([q, kv].map(|x| x.cast(DType::F64)), cotangent.cast(DType::F64), attend);
            for (native, reference) in native.into_iter().zip(reference) {
                if reference.clone().abs().max().into_scalar::<f64>() > 1e-12 {
                    assert_close(&native, &reference, 1e-5);
                }
            }
        }
    }

    #[test]
    fn chunked_queries_give_what_one_chunk_gives() {
        assert_eq!(query_chunks(1, 8, 4096, 4096).len(), 8);
        assert_eq!(query_chunks(1, 1, 3, MAX_SCORES * 2), [(0, 1), (1, 2), (2, 3)]);
        // 2 x 64 heads x 512 x 512 = 2^25 scores: two chunks.
        let device = Device::flex();
        // In f64, which takes the composed operation everywhere.
        let [q, k, v] = [1, 2, 3].map(|seed| random([2, 512, 64], seed, &device));
        assert_eq!(query_chunks(2, 64, 512, 512).len(), 2);
        let tracked = q.clone().autodiff().require_grad();
        let output = sdpa(tracked.clone(), k.clone().autodiff(), v.clone().autodiff(), 64);
        assert_close(&output.clone().inner(), &plain(q.clone(), k.clone(), v.clone(), 64), 1e-12);
        let ours = tracked.grad(&output.sum().backward()).expect("tracked");
        let tracked = q.autodiff().require_grad();
        let reference = plain(tracked.clone(), k.autodiff(), v.autodiff(), 64).sum().backward();
        // Rows of dS sum to nearly nothing under a constant cotangent, so compare absolutely.
        let difference = (ours - tracked.grad(&reference).expect("tracked")).abs().max().into_scalar::<f64>();
        assert!(difference < 1e-12, "{difference}");
    }

    #[test]
    fn extreme_logits_stay_finite_and_pick_the_largest() {
        for device in devices() {
            let device = device.autodiff();
            let q = (Tensor::<3>::ones([1, 2, 4], &device) * 200.0).require_grad();
            // Scores +-20000 against each other.
            let k = Tensor::cat(
                vec![Tensor::<3>::ones([1, 1, 4], &device) * 50.0, Tensor::ones([1, 1, 4], &device) * -50.0],
                1,
            )
            .require_grad();
            let v = Tensor::cat(vec![Tensor::<3>::ones([1, 1, 4], &device), Tensor::zeros([1, 1, 4], &device)], 1)
                .require_grad();
            let output = sdpa(q.clone(), k.clone(), v.clone(), 1);
            assert_close(&output.clone().inner(), &Tensor::ones([1, 2, 4], &device.clone().inner()), 0.0);
            let grads = output.sum().backward();
            for input in [q, k, v] {
                let gradient = input.grad(&grads).expect("tracked");
                assert!(gradient.is_finite().all().into_scalar::<bool>());
            }
        }
    }

    #[test]
    fn one_key_gives_its_value_and_equal_keys_their_mean() {
        for device in devices() {
            let q = Tensor::<3>::random([2, 3, 8], Distribution::Default, &device);
            let v = Tensor::<3>::random([2, 1, 8], Distribution::Default, &device);
            let output = sdpa(q.clone(), v.clone(), v.clone(), 2);
            assert_close(&output, &v.clone().expand([2, 3, 8]), 1e-6);
            let v = Tensor::<3>::random([2, 5, 8], Distribution::Default, &device);
            let output = sdpa(q, Tensor::ones([2, 5, 8], &device), v.clone(), 2);
            assert!(relative_error(&output, &v.mean_dim(1).expand([2, 3, 8])) < 1e-6);
        }
    }
}
