//! The kernels of a backend: what the operations and their gradients compute.
// B scenes, N tokens, D width, H heads, E = D/H width of a head

use burn::backend::tensor::FloatTensor;
use burn::backend::{Backend, TensorMetadata};
use burn::tensor::{DType, FloatDType, Shape};
use clift_kernels::HeadRows;

use crate::ops::composed::attention::{AttentionOutput, Qkv};
use crate::ops::composed::cluster_attention::ClusterInputs;
use crate::ops::composed::head_transform::Heads;
use crate::ops::composed::norms::LayerNormInputs;
use crate::ops::composed::{
    attention, cluster_attention, convolution, gelu, head_transform, linear, norms, primitives,
};
use crate::ops::precision::Precision;

/// The kernels of a backend. The default implementations run on every backend: compositions of Burn's operations, in the type
/// of their tensors. A backend overrides those for which it has native kernels.
pub trait Kernels: Backend {
    /// Multiplies matrices, `[.., M, K]` by `[.., K, N]`. Rounds f32 operands to `precision`, and no operands of another type
    /// (f64, in tests).
    ///
    /// Default: by Burn, [`matmul_bf16`](Self::matmul_bf16) or [`matmul_f16`](Self::matmul_f16).
    fn matmul(precision: Precision, lhs: FloatTensor<Self>, rhs: FloatTensor<Self>) -> FloatTensor<Self> {
        let precision = if lhs.dtype() == DType::F32 { precision } else { Precision::F32 };
        match precision {
            Precision::F32 => Self::float_matmul(lhs, rhs),
            Precision::Bf16 => Self::matmul_bf16(lhs, rhs),
            Precision::F16 => {
                Self::matmul_f16(Self::float_cast(lhs, FloatDType::F16), Self::float_cast(rhs, FloatDType::F16))
            }
        }
    }

    /// Multiplies f32 matrices whose values it rounds to bf16, and returns f32.
    ///
    /// Default: rounds the operands, then multiplies in f32.
    fn matmul_bf16(lhs: FloatTensor<Self>, rhs: FloatTensor<Self>) -> FloatTensor<Self> {
        let [lhs, rhs] = [lhs, rhs].map(|x| Self::float_cast(Self::float_cast(x, FloatDType::BF16), FloatDType::F32));
        Self::float_matmul(lhs, rhs)
    }

    /// Multiplies f16 matrices and returns f32.
    ///
    /// Default: rounds the product to f16 first, as most backends do.
    fn matmul_f16(lhs: FloatTensor<Self>, rhs: FloatTensor<Self>) -> FloatTensor<Self> {
        Self::float_cast(Self::float_matmul(lhs, rhs), FloatDType::F32)
    }

    /// Saves a tensor for the backward, possibly in less memory: without loss for operands of products, which are rounded
    /// anyway; the input of GELU is rounded to `precision`.
    ///
    /// Default: as it is.
    fn save(_precision: Precision, x: FloatTensor<Self>) -> SavedTensor<FloatTensor<Self>> {
        SavedTensor::whole(x)
    }

    /// Returns a saved tensor.
    fn restore(saved: SavedTensor<FloatTensor<Self>>) -> FloatTensor<Self> {
        saved.values
    }

    /// Computes `x W + b` of `x: [B, N, I]`, `W: [I, O]`, `b: [O]`, with operands of `precision`: `[B, N, O]`.
    ///
    /// Default: [`matmul`](Self::matmul), then a sum.
    fn linear_forward(precision: Precision, inputs: [FloatTensor<Self>; 3]) -> FloatTensor<Self> {
        linear::forward::<Self>(inputs, matmul_in::<Self>(precision))
    }

    /// Sums over the rows of all scenes, the gradient of a bias: `[B, N, O] -> [O]`.
    fn sum_rows(x: FloatTensor<Self>) -> FloatTensor<Self> {
        primitives::sum_rows::<Self>(x)
    }

    /// Computes GELU, `x Phi(x)` with the normal distribution function `Phi` (erf, not the tanh approximation), of every value.
    fn exact_gelu_forward(x: FloatTensor<Self>) -> FloatTensor<Self> {
        gelu::forward::<Self>(x)
    }

    /// Computes the gradient of `x`, `grad (Phi(x) + x phi(x))` with the normal density `phi`; Burn 0.22 differentiates the
    /// approximation on GPUs.
    fn exact_gelu_backward(x: FloatTensor<Self>, grad: FloatTensor<Self>) -> FloatTensor<Self> {
        gelu::backward::<Self>(x, grad)
    }

    /// Computes `(x - mean) / sqrt(variance + 1e-5) * gamma + beta` over the last dimension of `x: [B, N, D]`, with `gamma` and
    /// `beta: [D]`, and the mean and the inverse deviation of every row, `[BN, 2]`, if the backward reads them.
    ///
    /// Default: no statistics.
    fn layer_norm_forward(inputs: [FloatTensor<Self>; 3]) -> (FloatTensor<Self>, Option<FloatTensor<Self>>) {
        (norms::layer_norm_forward::<Self>(inputs), None)
    }

    /// Computes the gradients of `x`, `gamma` and `beta` from `grad: [B, N, D]`.
    fn layer_norm_backward(
        inputs: LayerNormInputs<FloatTensor<Self>>,
        grad: FloatTensor<Self>,
    ) -> [FloatTensor<Self>; 3] {
        norms::layer_norm_backward::<Self>(inputs, grad)
    }

    /// Computes `x / sqrt(mean(x^2) + epsilon) * gamma` of the heads of the first K parts of every row; the other parts stay.
    /// `x: [B, N, parts * D]`, gammas: `[K E]`.
    fn rms_norm_forward(inputs: [FloatTensor<Self>; 2], rows: HeadRows) -> FloatTensor<Self> {
        norms::rms_norm_forward::<Self>(inputs, rows)
    }

    /// Computes the gradients of `x` and the gammas from `grad: [B, N, parts * D]`.
    fn rms_norm_backward(
        inputs: [FloatTensor<Self>; 2],
        grad: FloatTensor<Self>,
        rows: HeadRows,
    ) -> [FloatTensor<Self>; 2] {
        norms::rms_norm_backward::<Self>(inputs, grad, rows)
    }

    /// Computes `softmax(q k^T / sqrt(E)) v` of every head, and the log sums if the backward reads them.
    ///
    /// Default: a chunk of queries at a time, without log sums.
    fn attention_forward(inputs: &Qkv<FloatTensor<Self>>, heads: HeadConfig) -> AttentionOutput<FloatTensor<Self>> {
        attention::forward::<Self>(inputs, heads.num_heads, matmul_in::<Self>(heads.precision))
    }

    /// Computes [`attention_forward`](Self::attention_forward), and [saves](Self::save) the inputs for the backward.
    fn attention_forward_saving(
        inputs: Qkv<FloatTensor<Self>>,
        heads: HeadConfig,
    ) -> (AttentionOutput<FloatTensor<Self>>, SavedQkv<FloatTensor<Self>>) {
        (Self::attention_forward(&inputs, heads), inputs.map(|x| Self::save(heads.precision, x)))
    }

    /// Computes the gradients of the inputs, in their layout, from the results of the forward pass and the gradient
    /// `[B, N, D]` of the output.
    ///
    /// Default: computes the scores again, a chunk of queries at a time.
    fn attention_backward(
        inputs: Qkv<FloatTensor<Self>>,
        results: AttentionOutput<FloatTensor<Self>>,
        heads: HeadConfig,
        grad_output: FloatTensor<Self>,
    ) -> Qkv<FloatTensor<Self>> {
        let matmul = matmul_in::<Self>(heads.precision);
        attention::backward::<Self>(&inputs, results.output, heads.num_heads, grad_output, matmul)
    }

    /// Computes attention of every centroid to the members of its segment: the output `[B, S, D]`, zeros for a segment without
    /// members, and the weights `[BM, H, 1]`.
    fn cluster_attention_forward(inputs: &ClusterInputs<Self>) -> [FloatTensor<Self>; 2] {
        cluster_attention::forward::<Self>(inputs)
    }

    /// Computes the gradients of `query` and `key_value` from the results of the forward pass and the gradient `[B, S, D]` of
    /// the output.
    fn cluster_attention_backward(
        inputs: ClusterInputs<Self>,
        results: [FloatTensor<Self>; 2],
        grad_output: FloatTensor<Self>,
    ) -> [FloatTensor<Self>; 2] {
        cluster_attention::backward::<Self>(inputs, results, grad_output)
    }

    /// Transforms the heads of `x: [B, N, parts * D]` by the transforms of their tokens, `[B, N, transform_len(E)]`, transposed
    /// for the gradient.
    fn head_transform(
        x: FloatTensor<Self>,
        transforms: FloatTensor<Self>,
        heads: Heads,
        is_gradient: bool,
    ) -> FloatTensor<Self> {
        head_transform::transform::<Self>(&x, &transforms, heads, is_gradient)
    }

    /// Convolves images `[B, I, H, W]` with zeros around them by `weight: [O, I, 3, 3]` and adds `bias: [O]`.
    fn convolution(x: FloatTensor<Self>, weight: FloatTensor<Self>, bias: FloatTensor<Self>) -> FloatTensor<Self> {
        convolution::forward::<Self>(x, weight, bias)
    }

    /// Computes the gradient of `x` from `grad: [B, O, H, W]`.
    fn convolution_backward(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        grad: FloatTensor<Self>,
    ) -> FloatTensor<Self> {
        convolution::backward::<Self>(x, weight, grad)
    }
}

/// Returns the matrix product with operands of `precision`, for composed operations.
pub(crate) fn matmul_in<B: Kernels>(precision: Precision) -> impl Fn(FloatTensor<B>, FloatTensor<B>) -> FloatTensor<B> {
    move |lhs, rhs| B::matmul(precision, lhs, rhs)
}

/// Number of heads and precision of an attention.
#[derive(Clone, Copy, Debug)]
pub struct HeadConfig {
    pub(crate) num_heads: usize,
    pub(crate) precision: Precision,
}

impl HeadConfig {
    /// Returns the configuration of an attention in the current precision of this thread.
    pub(crate) fn now(num_heads: usize) -> Self {
        Self { num_heads, precision: Precision::current() }
    }
}

/// A tensor that is saved for a backward.
#[derive(Clone, Debug)]
pub struct SavedTensor<T> {
    pub(crate) values: T,
    /// Shape of a tensor that is saved in bf16, two of its values in each of `values`.
    pub(crate) packed: Option<Shape>,
}

/// Queries, keys and values that are saved for a backward.
pub(crate) type SavedQkv<T> = Qkv<SavedTensor<T>>;

impl<T> SavedTensor<T> {
    /// Saves a tensor as it is.
    pub(crate) fn whole(values: T) -> Self {
        Self { values, packed: None }
    }
}
