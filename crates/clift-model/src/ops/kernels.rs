//! The kernels of a backend: what the operations and their gradients compute.
// B scenes, N tokens, D width, H heads, E = D/H width of a head

use burn::backend::tensor::{FloatTensor, IntTensor};
use burn::backend::{Backend, TensorMetadata};
use burn::tensor::{DType, FloatDType, Shape};
use clift_kernels::{HeadRows, HeadTransform};

use crate::ops::composed::cluster_attention::Clusters;
use crate::ops::composed::{attention, cluster_attention, head_transform, layers, primitives};
use crate::ops::precision::Precision;

/// The kernels of a backend. The default implementations run on every backend: compositions of Burn's operations, in the type
/// of their tensors. A backend overrides those for which it has native kernels.
pub trait Kernels: Backend {
    /// Multiplies matrices, `[.., M, K]` by `[.., K, N]`. Rounds f32 operands to `precision`, and no operands of another type
    /// (f64, in tests).
    ///
    /// Default: by Burn or [`matmul_bf16`](Self::matmul_bf16); a product of f16 is rounded to f16, as most backends do.
    fn matmul(precision: Precision, lhs: FloatTensor<Self>, rhs: FloatTensor<Self>) -> FloatTensor<Self> {
        let precision = if lhs.dtype() == DType::F32 { precision } else { Precision::F32 };
        match precision {
            Precision::F32 => Self::float_matmul(lhs, rhs),
            Precision::Bf16 => Self::matmul_bf16(lhs, rhs),
            Precision::F16 => {
                let [lhs, rhs] = [lhs, rhs].map(|x| Self::float_cast(x, FloatDType::F16));
                Self::float_cast(Self::float_matmul(lhs, rhs), FloatDType::F32)
            }
        }
    }

    /// Multiplies f32 matrices whose values it rounds to bf16, and returns f32.
    fn matmul_bf16(lhs: FloatTensor<Self>, rhs: FloatTensor<Self>) -> FloatTensor<Self> {
        let [lhs, rhs] = [lhs, rhs].map(|x| Self::float_cast(Self::float_cast(x, FloatDType::BF16), FloatDType::F32));
        Self::float_matmul(lhs, rhs)
    }

    /// Saves a tensor for the backward, possibly in less memory: without loss for operands of products, which are rounded
    /// anyway; the input of GELU is rounded to `precision`.
    fn save(_precision: Precision, x: FloatTensor<Self>) -> SavedTensor<FloatTensor<Self>> {
        SavedTensor::whole(x)
    }

    fn restore(saved: SavedTensor<FloatTensor<Self>>) -> FloatTensor<Self> {
        saved.values
    }

    /// Computes `x W + b` of `x: [B, N, I]`, `W: [I, O]`, `b: [O]`, with operands of `precision`: `[B, N, O]`.
    fn linear_forward(precision: Precision, inputs: [FloatTensor<Self>; 3]) -> FloatTensor<Self> {
        layers::linear::<Self>(inputs, matmul_in::<Self>(precision))
    }

    /// Sums over the rows of all scenes, the gradient of a bias: `[B, N, O] -> [O]`.
    fn sum_rows(x: FloatTensor<Self>) -> FloatTensor<Self> {
        primitives::sum_rows::<Self>(x)
    }

    /// Computes `x Phi(x)` with the normal distribution function `Phi` (erf, not the tanh approximation).
    fn exact_gelu_forward(x: FloatTensor<Self>) -> FloatTensor<Self> {
        layers::gelu_forward::<Self>(x)
    }

    /// Computes the gradient of `x`, `grad (Phi(x) + x phi(x))` with the normal density `phi`; Burn 0.22 differentiates the
    /// approximation on GPUs.
    fn exact_gelu_backward(x: FloatTensor<Self>, grad: FloatTensor<Self>) -> FloatTensor<Self> {
        layers::gelu_backward::<Self>(x, grad)
    }

    /// Computes `(x - mean) / sqrt(variance + 1e-5) * gamma + beta` over the last dimension of `x: [B, N, D]`, with `gamma` and
    /// `beta: [D]`, and the mean and the inverse deviation of every row, `[BN, 2]`, if the backward reads them.
    fn layer_norm_forward(inputs: [FloatTensor<Self>; 3]) -> (FloatTensor<Self>, Option<FloatTensor<Self>>) {
        (layers::layer_norm_forward::<Self>(inputs), None)
    }

    /// Computes the gradients of `x`, `gamma` and `beta` from `x`, `gamma`, the gradient `[B, N, D]` of the output, and the
    /// statistics of the forward pass.
    fn layer_norm_backward(
        inputs: [FloatTensor<Self>; 3],
        _statistics: Option<FloatTensor<Self>>,
    ) -> [FloatTensor<Self>; 3] {
        layers::layer_norm_backward::<Self>(inputs)
    }

    /// Computes `x / sqrt(mean(x^2) + epsilon) * gamma` of the heads of the first K parts of every row; the other parts stay.
    /// `x: [B, N, parts * D]`, gammas: `[K E]`.
    fn rms_norm_forward(inputs: [FloatTensor<Self>; 2], rows: HeadRows) -> FloatTensor<Self> {
        layers::rms_norm_forward::<Self>(inputs, rows)
    }

    /// Computes the gradients of `x` and the gammas from both and the gradient `[B, N, parts * D]` of the output.
    fn rms_norm_backward(inputs: [FloatTensor<Self>; 3], rows: HeadRows) -> [FloatTensor<Self>; 2] {
        layers::rms_norm_backward::<Self>(inputs, rows)
    }

    /// Computes `softmax(q k^T / sqrt(E)) v` of every head of the inputs that [`parts`](attention::parts) describes, `[B, Q, D]`,
    /// and the logarithm of the sum of every row of scores, `[B, H, Q]`, if the backward reads it.
    fn attention_forward<const N: usize>(
        inputs: &[FloatTensor<Self>; N],
        heads: HeadConfig,
    ) -> AttentionResults<FloatTensor<Self>> {
        (attention::forward::<Self, N>(inputs, heads.num_heads, matmul_in::<Self>(heads.precision)), None)
    }

    /// Computes [`attention_forward`](Self::attention_forward), and [saves](Self::save) the inputs for the backward.
    fn attention_forward_saving<const N: usize>(
        inputs: [FloatTensor<Self>; N],
        heads: HeadConfig,
    ) -> (AttentionResults<FloatTensor<Self>>, [SavedTensor<FloatTensor<Self>>; N]) {
        (Self::attention_forward(&inputs, heads), inputs.map(|x| Self::save(heads.precision, x)))
    }

    /// Computes the gradients of the inputs from the results of the forward pass and the gradient `[B, Q, D]` of the output.
    fn attention_backward<const N: usize>(
        inputs: [FloatTensor<Self>; N],
        (output, _log_sum): AttentionResults<FloatTensor<Self>>,
        heads: HeadConfig,
        grad_output: FloatTensor<Self>,
    ) -> [FloatTensor<Self>; N] {
        let matmul = matmul_in::<Self>(heads.precision);
        attention::backward::<Self, N>(&inputs, output, heads.num_heads, grad_output, matmul)
    }

    /// Computes attention of every centroid to the members of its segment, from queries `[B, S, D]`, and keys and values side by
    /// side, `[B, M, 2D]`: the output `[B, S, D]`, zeros for a segment without members, and the weights `[BM, H, 1]`.
    fn cluster_attention_forward(
        inputs: [FloatTensor<Self>; 2],
        clusters: Clusters<IntTensor<Self>>,
    ) -> [FloatTensor<Self>; 2] {
        cluster_attention::forward::<Self>(inputs, clusters)
    }

    /// Computes the gradients of the inputs from them, both results of the forward pass and the gradient `[B, S, D]` of the output.
    fn cluster_attention_backward(
        tensors: [FloatTensor<Self>; 5],
        clusters: Clusters<IntTensor<Self>>,
    ) -> [FloatTensor<Self>; 2] {
        cluster_attention::backward::<Self>(tensors, clusters)
    }

    /// Transforms the heads of `x: [B, N, parts * D]` by the transforms of their tokens, `[B, N, transform_len(E)]`.
    fn head_transform(
        x: FloatTensor<Self>,
        transforms: FloatTensor<Self>,
        parts: &[HeadTransform],
        num_heads: usize,
    ) -> FloatTensor<Self> {
        head_transform::transform::<Self>(&x, &transforms, parts, num_heads)
    }

    /// Convolves images `[B, I, H, W]` with zeros around them by a weight `[O, I, 3, 3]` and adds a bias `[O]`.
    fn convolution(inputs: [FloatTensor<Self>; 3]) -> FloatTensor<Self> {
        layers::convolution::<Self>(inputs)
    }

    /// Computes the gradient of the images from them, the weight and the gradient `[B, O, H, W]` of the output.
    fn convolution_backward(inputs: [FloatTensor<Self>; 3]) -> FloatTensor<Self> {
        layers::convolution_backward::<Self>(inputs)
    }
}

/// Returns the matrix product with operands of `precision`, for composed operations.
pub(crate) fn matmul_in<B: Kernels>(precision: Precision) -> impl Fn(FloatTensor<B>, FloatTensor<B>) -> FloatTensor<B> {
    move |lhs, rhs| B::matmul(precision, lhs, rhs)
}

/// Output of an attention, and its log sums if the native kernel computed them.
pub(crate) type AttentionResults<T> = (T, Option<T>);

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

impl<T> SavedTensor<T> {
    pub(crate) fn whole(values: T) -> Self {
        Self { values, packed: None }
    }
}
