//! Scaled dot-product attention as one operation with its own backward, and the layers made of it.
//!
//! Under autodiff Burn's own attention keeps about three score maps per head (13.5 GiB for one
//! scene of 4,096 tokens). [`sdpa`] keeps its inputs and its output, and computes the scores again
//! in the backward, a chunk of queries at a time: memory is linear in the number of tokens.
#![expect(deprecated, reason = "upstream retires ndarray in favour of flex; it stays as an independent check")]
// B scenes, Q queries, K keys, D width, H heads, E = D/H width of a head

use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, Dispatch, Flex, NdArray, TensorMetadata, backend_extension};
use burn::module::Module;
use burn::nn::Linear;
use burn::tensor::{Shape, Slice, Tensor, assert_shape};

use crate::Init;

/// Attention of every query to every key, `softmax(q k^T / sqrt(head width)) v`, unmasked.
///
/// Its gradient is exact and first order. Scores are shifted by their row's maximum, so finite
/// inputs give finite outputs whatever the size of the logits.
///
/// # Shapes
/// - `query`: `[batch, num_queries, dim]`, `key` and `value`: `[batch, num_keys, dim]`; head `h` is
///   columns `h * dim / num_heads ..`
/// - returns `[batch, num_queries, dim]`
pub fn sdpa(query: Tensor<3>, key: Tensor<3>, value: Tensor<3>, num_heads: usize) -> Tensor<3> {
    let [batch, _num_queries, dim] = query.dims();
    let [_, num_keys, _] = key.dims();
    assert_shape!(key, [batch, num_keys, dim]);
    assert_shape!(value, [batch, num_keys, dim]);
    assert!(dim.is_multiple_of(num_heads), "{num_heads} heads do not divide a width of {dim}");
    Tensor::from_dispatch(<Dispatch as AttentionOps>::sdpa(
        query.into_dispatch(),
        key.into_dispatch(),
        value.into_dispatch(),
        num_heads,
    ))
}

/// The operation behind [`sdpa`] on a device. The body here runs on every one of them.
#[backend_extension(Flex, NdArray, Cube: cfg(feature = "wgpu"), Autodiff)]
pub trait AttentionOps: Backend {
    /// See [`sdpa`].
    fn sdpa(
        query: FloatTensor<Self>,
        key: FloatTensor<Self>,
        value: FloatTensor<Self>,
        num_heads: usize,
    ) -> FloatTensor<Self> {
        forward::<Self>(query, key, value, num_heads)
    }
}

impl AttentionOps for Flex {}
impl AttentionOps for NdArray {}
#[cfg(feature = "wgpu")]
impl AttentionOps for burn::backend::Cube {}

impl<B: AttentionOps, C: CheckpointStrategy> AttentionOps for Autodiff<B, C> {
    fn sdpa(
        query: FloatTensor<Self>,
        key: FloatTensor<Self>,
        value: FloatTensor<Self>,
        num_heads: usize,
    ) -> FloatTensor<Self> {
        let ((query, query_node), (key, key_node), (value, value_node)) =
            (query.into_parts(), key.into_parts(), value.into_parts());
        match SdpaBackward.prepare::<C>([query_node, key_node, value_node]).compute_bound().stateful() {
            OpsKind::Tracked(prep) => {
                let output = B::sdpa(query.clone(), key.clone(), value.clone(), num_heads);
                prep.finish(SdpaState { query, key, value, output: output.clone(), num_heads }, output)
            }
            OpsKind::UnTracked(prep) => prep.finish(B::sdpa(query, key, value, num_heads)),
        }
    }
}

#[derive(Debug)]
struct SdpaBackward;

#[derive(Clone, Debug)]
struct SdpaState<T> {
    query: T,
    key: T,
    value: T,
    output: T,
    num_heads: usize,
}

impl<B: Backend> Backward<B, 3> for SdpaBackward {
    type State = SdpaState<FloatTensor<B>>;

    fn backward(self, ops: Ops<Self::State, 3>, grads: &mut Gradients, _checkpointer: &mut Checkpointer) {
        let grad_output = grads.consume::<B>(&ops.node);
        let gradients = backward::<B>(ops.state, grad_output);
        for (parent, gradient) in ops.parents.into_iter().zip(gradients) {
            if let Some(node) = parent {
                grads.register::<B>(node.id, gradient);
            }
        }
    }
}

/// Scores held at once, over all scenes and heads: 64 MiB in f32. A scene of 4,096 tokens with 8
/// heads is then worked off in chunks of 512 queries.
const MAX_SCORES: usize = 1 << 24;

/// Ranges of queries whose scores fit [`MAX_SCORES`] together.
fn query_chunks(batch: usize, num_heads: usize, num_queries: usize, num_keys: usize) -> Vec<(usize, usize)> {
    let chunk = (MAX_SCORES / (batch * num_heads * num_keys).max(1)).clamp(1, num_queries.max(1));
    (0..num_queries).step_by(chunk).map(|start| (start, (start + chunk).min(num_queries))).collect()
}

fn forward<B: Backend>(
    query: FloatTensor<B>,
    key: FloatTensor<B>,
    value: FloatTensor<B>,
    num_heads: usize,
) -> FloatTensor<B> {
    let [batch, num_queries, dim] = query.shape().dims();
    let num_keys = key.shape()[1];
    let query = split_heads::<B>(B::float_mul_scalar(query, scale(dim, num_heads).into()), num_heads);
    let key_t = B::float_swap_dims(split_heads::<B>(key, num_heads), 2, 3); // [B, H, E, K]
    let value = split_heads::<B>(value, num_heads);
    let chunks = query_chunks(batch, num_heads, num_queries, num_keys).into_iter().map(|range| {
        let scores = B::float_matmul(rows::<B>(&query, range), key_t.clone()); // [B, H, chunk, K]
        B::float_matmul(B::softmax(scores, 3), value.clone())
    });
    merge_heads::<B>(concat::<B>(chunks.collect()))
}

/// With `P = softmax(s q k^T)`: `dV = P^T dO`, `dS = P * (dO V^T - rowsum(dO * O))`,
/// `dQ = s dS K`, `dK = s dS^T Q`, a chunk of queries at a time.
fn backward<B: Backend>(state: SdpaState<FloatTensor<B>>, grad_output: FloatTensor<B>) -> [FloatTensor<B>; 3] {
    let SdpaState { query, key, value, output, num_heads } = state;
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
        let weights = B::softmax(B::float_matmul(query.clone(), key_t.clone()), 3);
        let grad_weights = B::float_matmul(grad_output.clone(), value_t.clone());
        let grad_scores = B::float_mul(weights.clone(), B::float_sub(grad_weights, rows::<B>(&delta, range)));
        let grad_value = B::float_matmul(B::float_swap_dims(weights, 2, 3), grad_output);
        // The query carries the scale already.
        let grad_key = B::float_matmul(B::float_swap_dims(grad_scores.clone(), 2, 3), query);
        grad_query.push(B::float_matmul(grad_scores, key.clone()));
        grad_key_value = Some(match grad_key_value {
            None => (grad_key, grad_value),
            Some((key_sum, value_sum)) => (B::float_add(key_sum, grad_key), B::float_add(value_sum, grad_value)),
        });
    }
    let (grad_key, grad_value) = grad_key_value.expect("attention has at least one query");
    let grad_query = B::float_mul_scalar(merge_heads::<B>(concat::<B>(grad_query)), scale.into());
    [grad_query, merge_heads::<B>(grad_key), merge_heads::<B>(grad_value)]
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

/// Rows `start..end` of every head.
fn rows<B: Backend>(x: &FloatTensor<B>, (start, end): (usize, usize)) -> FloatTensor<B> {
    let [batch, num_heads, count, width] = x.shape().dims();
    if (start, end) == (0, count) {
        return x.clone();
    }
    let ranges = [0..batch, 0..num_heads, start..end, 0..width].map(Slice::from);
    B::float_slice(x.clone(), &ranges)
}

fn concat<B: Backend>(mut chunks: Vec<FloatTensor<B>>) -> FloatTensor<B> {
    if chunks.len() == 1 { chunks.remove(0) } else { B::float_cat(chunks, 2) }
}

/// Self-attention with a packed projection (paper section 3.1: eight heads).
#[derive(Module, Debug)]
pub struct SelfAttention {
    in_proj: Linear,
    out_proj: Linear,
    #[module(skip)]
    num_heads: usize,
}

impl SelfAttention {
    /// Makes the layer with PyTorch's initialisation of multi-head attention.
    pub fn new(dim: usize, num_heads: usize, init: &mut Init) -> Self {
        Self { in_proj: init.attention_in(dim, 3), out_proj: init.attention_out(dim), num_heads }
    }

    /// Mixes tokens of the same scene.
    ///
    /// # Shapes
    /// - `x` and the result: `[batch, count, dim]`
    pub fn forward(&self, x: Tensor<3>) -> Tensor<3> {
        let [query, key, value] = split(self.in_proj.forward(x));
        self.out_proj.forward(sdpa(query, key, value, self.num_heads))
    }
}

/// Attention from one set of tokens to another.
#[derive(Module, Debug)]
pub struct CrossAttention {
    q_proj: Linear,
    kv_proj: Linear,
    out_proj: Linear,
    #[module(skip)]
    num_heads: usize,
}

impl CrossAttention {
    /// Makes the layer with PyTorch's initialisation of multi-head attention.
    pub fn new(dim: usize, num_heads: usize, init: &mut Init) -> Self {
        Self {
            q_proj: init.attention_in(dim, 1),
            kv_proj: init.attention_in(dim, 2),
            out_proj: init.attention_out(dim),
            num_heads,
        }
    }

    /// Gives every query what it finds among the memory's tokens.
    ///
    /// # Shapes
    /// - `x`: `[batch, num_queries, dim]`, `memory`: `[batch, num_keys, dim]`
    /// - returns `[batch, num_queries, dim]`
    pub fn forward(&self, x: Tensor<3>, memory: Tensor<3>) -> Tensor<3> {
        let (key, value) = self.project_memory(memory);
        self.out_proj.forward(sdpa(self.project_query(x), key, value, self.num_heads))
    }

    /// Queries, `[batch, num_queries, dim]`.
    pub(crate) fn project_query(&self, x: Tensor<3>) -> Tensor<3> {
        self.q_proj.forward(x)
    }

    /// Keys and values, each `[batch, num_keys, dim]`.
    pub(crate) fn project_memory(&self, memory: Tensor<3>) -> (Tensor<3>, Tensor<3>) {
        let [key, value] = split(self.kv_proj.forward(memory));
        (key, value)
    }

    /// The projection after the heads.
    pub(crate) fn project_out(&self, x: Tensor<3>) -> Tensor<3> {
        self.out_proj.forward(x)
    }

    pub(crate) fn num_heads(&self) -> usize {
        self.num_heads
    }
}

/// Cuts a packed projection into its `COUNT` parts.
fn split<const COUNT: usize>(packed: Tensor<3>) -> [Tensor<3>; COUNT] {
    let dim = packed.dims()[2] / COUNT;
    std::array::from_fn(|part| packed.clone().narrow(2, part * dim, dim))
}

#[cfg(test)]
mod tests {
    use burn::tensor::{DType, Device, Distribution};

    use super::*;
    use crate::testing::{Fixture, assert_close, check_gradients, cpu_devices, devices, random, relative_error};

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
    fn chunked_queries_give_what_one_chunk_gives() {
        assert_eq!(query_chunks(1, 8, 4096, 4096).len(), 8);
        assert_eq!(query_chunks(1, 1, 3, MAX_SCORES * 2), [(0, 1), (1, 2), (2, 3)]);
        // 2 x 64 heads x 512 x 512 = 2^25 scores: two chunks.
        let device = Device::flex();
        let inputs = [1, 2, 3].map(|seed| random([2, 512, 64], seed, &device).cast(DType::F32));
        let [q, k, v] = inputs;
        assert_eq!(query_chunks(2, 64, 512, 512).len(), 2);
        let tracked = q.clone().autodiff().require_grad();
        let output = sdpa(tracked.clone(), k.clone().autodiff(), v.clone().autodiff(), 64);
        assert_close(&output.clone().inner(), &plain(q.clone(), k.clone(), v.clone(), 64), 1e-6);
        let ours = tracked.grad(&output.sum().backward()).expect("tracked");
        let tracked = q.autodiff().require_grad();
        let reference = plain(tracked.clone(), k.autodiff(), v.autodiff(), 64).sum().backward();
        // Rows of dS sum to nearly nothing under a constant cotangent, so compare absolutely.
        let difference = (ours - tracked.grad(&reference).expect("tracked")).abs().max().into_scalar::<f32>();
        assert!(difference < 1e-5, "{difference}");
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
