//! Linear layers as one operation, alone or fused with a preceding GELU or layer norm.
//!
//! The result of the GELU or norm is not kept for the backward but computed again from its input: the GELU's result is
//! the widest activation of a transformer block, and every block has two or three norms.
// B scenes, N rows of a scene, I inputs, O outputs

use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, Dispatch, Flex, TensorMetadata, backend_extension};
use burn::module::Param;
use burn::nn::{LayerNorm, Linear};
use burn::tensor::{Shape, Tensor, assert_shape};
use clift_kernels::{InstructionSet, Matrix, OperandType, linear_forward, matmul_bf16, sum_rows};

use crate::ops::autodiff::register;
use crate::ops::flex::{contiguous, is_native, tensor, values};
use crate::ops::gelu::GeluKernels;
use crate::ops::layer_norm::{LayerNormKernels, NormState};
use crate::ops::mac_counter;
use crate::ops::precision::{MatmulKernels, Precision};
use crate::ops::saved::{SaveKernels, Saved};

/// Computes `x W + b`, with `b = 0` for a layer without bias.
///
/// # Shapes
/// - `x`: `[batch, count, inputs]`
/// - returns `[batch, count, outputs]`
pub fn linear(layer: &Linear, x: Tensor<3>) -> Tensor<3> {
    apply(layer, x, Prologue { gelu: false, precision: Precision::current() })
}

/// Computes [`linear`] in f32, independent of the precision of this thread: for layers whose inputs are rays, and for gates.
pub fn linear_in_f32(layer: &Linear, x: Tensor<3>) -> Tensor<3> {
    apply(layer, x, Prologue { gelu: false, precision: Precision::F32 })
}

/// Computes `gelu(x) W + b` with `gelu(x) = x Phi(x)` and the normal distribution function `Phi`.
///
/// # Shapes
/// - `x`: `[batch, count, inputs]`
/// - returns `[batch, count, outputs]`
pub fn gelu_linear(layer: &Linear, x: Tensor<3>) -> Tensor<3> {
    apply(layer, x, Prologue { gelu: true, precision: Precision::current() })
}

/// Computes `norm(x) W + b` with `norm(x) = (x - mean) / sqrt(variance + 1e-5) * gamma + beta` per row, with `beta = 0` for
/// a norm without bias.
///
/// # Shapes
/// - `x`: `[batch, count, inputs]`
/// - returns `[batch, count, outputs]`
pub fn norm_linear(norm: &LayerNorm, layer: &Linear, x: Tensor<3>) -> Tensor<3> {
    let gamma = norm.gamma.val();
    let beta = norm.beta.as_ref().map_or_else(|| gamma.clone().detach().zeros_like(), Param::val);
    norm_then_linear(x, gamma, beta, layer)
}

/// The computation before the bias of a layer is added.
#[derive(Clone, Copy, Debug)]
pub struct Prologue {
    gelu: bool,
    precision: Precision,
}

fn apply(layer: &Linear, x: Tensor<3>, prologue: Prologue) -> Tensor<3> {
    let (weight, bias) = parameters(layer, &x);
    let [x, weight, bias] = [x.into_dispatch(), weight.into_dispatch(), bias.into_dispatch()];
    Tensor::from_dispatch(<Dispatch as LinearOps>::linear_layer(x, weight, bias, prologue))
}

pub(crate) fn norm_then_linear(x: Tensor<3>, gamma: Tensor<1>, beta: Tensor<1>, layer: &Linear) -> Tensor<3> {
    let (weight, bias) = parameters(layer, &x);
    let [inputs, _outputs] = weight.dims();
    assert_shape!(gamma, [inputs]);
    assert_shape!(beta, [inputs]);
    Tensor::from_dispatch(<Dispatch as LinearOps>::norm_then_linear(
        x.into_dispatch(),
        gamma.into_dispatch(),
        beta.into_dispatch(),
        weight.into_dispatch(),
        bias.into_dispatch(),
        Precision::current(),
    ))
}

/// Returns weight and bias, zeros without one, of a layer with input `x`, and counts its multiply-accumulates.
fn parameters(layer: &Linear, x: &Tensor<3>) -> (Tensor<2>, Tensor<1>) {
    let weight = layer.weight.val();
    let ([inputs, outputs], [batch, count, _]) = (weight.dims(), x.dims());
    let no_bias = || Tensor::zeros([outputs], (&weight.device(), weight.dtype()));
    let bias = layer.bias.as_ref().map_or_else(no_bias, Param::val);
    assert_shape!(x, [.., inputs]);
    mac_counter::add_linear(batch * count, inputs, outputs);
    (weight, bias)
}

/// The operations of [`linear`], [`gelu_linear`] and [`norm_linear`] on a backend.
#[backend_extension(Flex, NdArray: cfg(feature = "ndarray"), Cube: cfg(feature = "wgpu"), Autodiff)]
pub trait LinearOps: Backend {
    fn linear_layer(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        prologue: Prologue,
    ) -> FloatTensor<Self>;

    fn norm_then_linear(
        x: FloatTensor<Self>,
        gamma: FloatTensor<Self>,
        beta: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        precision: Precision,
    ) -> FloatTensor<Self>;
}

/// Parts of the operations on a backend. The default implementations run on every backend.
pub trait LinearKernels: GeluKernels + LayerNormKernels + MatmulKernels + SaveKernels {
    /// Computes `x W + b`: `[B, N, I] -> [B, N, O]`.
    fn linear_output(precision: Precision, inputs: [FloatTensor<Self>; 3]) -> FloatTensor<Self> {
        composed_output::<Self>(precision, inputs)
    }

    /// Sums over rows: `[B, N, O] -> [O]`.
    fn sum_rows(x: FloatTensor<Self>) -> FloatTensor<Self> {
        composed_sum_rows::<Self>(x)
    }
}

fn composed_output<B: MatmulKernels>(precision: Precision, [x, weight, bias]: [FloatTensor<B>; 3]) -> FloatTensor<B> {
    let [batch, count, _] = x.shape().dims();
    let [_, outputs] = weight.shape().dims();
    let product = B::matmul(precision, rows::<B>(x), weight); // [BN, O]
    let bias = B::float_expand(B::float_reshape(bias, Shape::new([1, outputs])), product.shape());
    B::float_reshape(B::float_add(product, bias), Shape::new([batch, count, outputs]))
}

fn composed_sum_rows<B: Backend>(x: FloatTensor<B>) -> FloatTensor<B> {
    let x = rows::<B>(x);
    let [_, outputs] = x.shape().dims();
    B::float_reshape(B::float_sum_dim(x, 0), Shape::new([outputs]))
}

/// `[B, N, D] -> [BN, D]`
fn rows<B: Backend>(x: FloatTensor<B>) -> FloatTensor<B> {
    let [batch, count, dim] = x.shape().dims();
    B::float_reshape(x, Shape::new([batch * count, dim]))
}

impl LinearKernels for Flex {
    fn linear_output(precision: Precision, inputs: [FloatTensor<Self>; 3]) -> FloatTensor<Self> {
        let [x, weight, _bias] = &inputs;
        let Some(operands) = precision.native_operands().filter(|_| is_native(x)) else {
            return composed_output::<Self>(precision, inputs);
        };
        let [batch, count, width] = x.shape().dims();
        let [_, outputs] = weight.shape().dims();
        let inputs = inputs.map(contiguous);
        let mut output = vec![0.0; batch * count * outputs];
        let sizes = [batch * count, width, outputs];
        let [x, weight, bias] = inputs.each_ref().map(values);
        match operands {
            OperandType::F32 => linear_forward(sizes, [x, weight, bias], &mut output),
            OperandType::Bf16 => {
                let factors = [x, weight].map(|values| Matrix { values, transposed: false });
                matmul_bf16(InstructionSet::detected(), sizes, factors, Some(bias), &mut output);
            }
        }
        tensor(output, [batch, count, outputs])
    }

    fn sum_rows(x: FloatTensor<Self>) -> FloatTensor<Self> {
        if !is_native(&x) {
            return composed_sum_rows::<Self>(x);
        }
        let [_, _, outputs] = x.shape().dims();
        let mut sum = vec![0.0; outputs];
        sum_rows(InstructionSet::detected(), values(&contiguous(x)), &mut sum);
        tensor(sum, [outputs])
    }
}

#[cfg(feature = "ndarray")]
impl LinearKernels for burn::backend::NdArray {}
#[cfg(feature = "wgpu")]
impl LinearKernels for burn::backend::Cube {}

fn forward<B: LinearKernels>([x, weight, bias]: [FloatTensor<B>; 3], prologue: Prologue) -> FloatTensor<B> {
    let x = if prologue.gelu { B::gelu_output(x) } else { x };
    B::linear_output(prologue.precision, [x, weight, bias])
}

impl<B: LinearKernels> LinearOps for B {
    fn linear_layer(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        prologue: Prologue,
    ) -> FloatTensor<Self> {
        forward::<Self>([x, weight, bias], prologue)
    }

    fn norm_then_linear(
        x: FloatTensor<Self>,
        gamma: FloatTensor<Self>,
        beta: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        precision: Precision,
    ) -> FloatTensor<Self> {
        let (normal, _statistics) = Self::norm_output([x, gamma, beta]);
        Self::linear_output(precision, [normal, weight, bias])
    }
}

impl<B: LinearKernels, C: CheckpointStrategy> LinearOps for Autodiff<B, C> {
    fn linear_layer(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        prologue: Prologue,
    ) -> FloatTensor<Self> {
        let ((x, x_node), (weight, weight_node), (bias, bias_node)) =
            (x.into_parts(), weight.into_parts(), bias.into_parts());
        match LinearBackward.prepare::<C>([x_node, weight_node, bias_node]).compute_bound().stateful() {
            OpsKind::Tracked(prep) => {
                let output = forward::<B>([x.clone(), weight.clone(), bias], prologue);
                // Other inputs may be held by other operations, too: the result of attention, the tokens of a scene.
                let x = if prologue.gelu { B::save(prologue.precision, x) } else { Saved::whole(x) };
                prep.finish(LinearState { x, weight, prologue }, output)
            }
            OpsKind::UnTracked(prep) => prep.finish(forward::<B>([x, weight, bias], prologue)),
        }
    }

    fn norm_then_linear(
        x: FloatTensor<Self>,
        gamma: FloatTensor<Self>,
        beta: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        precision: Precision,
    ) -> FloatTensor<Self> {
        let ((x, x_node), (gamma, gamma_node), (beta, beta_node)) =
            (x.into_parts(), gamma.into_parts(), beta.into_parts());
        let ((weight, weight_node), (bias, bias_node)) = (weight.into_parts(), bias.into_parts());
        let nodes = [x_node, gamma_node, beta_node, weight_node, bias_node];
        match NormLinearBackward.prepare::<C>(nodes).compute_bound().stateful() {
            OpsKind::Tracked(prep) => {
                let (normal, statistics) = B::norm_output([x.clone(), gamma.clone(), beta.clone()]);
                let output = B::linear_output(precision, [normal, weight.clone(), bias]);
                let norm = NormState { x, gamma, statistics };
                prep.finish(NormLinearState { norm, beta, weight, precision }, output)
            }
            OpsKind::UnTracked(prep) => prep.finish(B::norm_then_linear(x, gamma, beta, weight, bias, precision)),
        }
    }
}

#[derive(Debug)]
struct LinearBackward;

#[derive(Clone, Debug)]
struct LinearState<T> {
    x: Saved<T>,
    weight: T,
    prologue: Prologue,
}

impl<B: LinearKernels> Backward<B, 3> for LinearBackward {
    type State = LinearState<FloatTensor<B>>;

    /// With `a = x` or `gelu(x)`: `dW = a^T dO`, `db = sum dO`, `da = dO W^T`.
    fn backward(self, ops: Ops<Self::State, 3>, grads: &mut Gradients, _checkpointer: &mut Checkpointer) {
        register::<B, _, 3>(ops, grads, |LinearState { x, weight, prologue }, grad, needed| {
            let Prologue { gelu, precision } = prologue;
            let [of_x, of_weight, of_bias] = needed;
            let x = B::restore(x);
            let grad_bias = of_bias.then(|| B::sum_rows(grad.clone()));
            let grad_weight = of_weight.then(|| {
                let activation = if gelu { B::gelu_output(x.clone()) } else { x.clone() };
                grad_of_weight::<B>(precision, activation, grad.clone())
            });
            let grad_x = of_x.then(|| {
                let grad = grad_of_input::<B>(precision, grad, weight);
                if gelu { B::gelu_grad(x, grad) } else { grad }
            });
            [grad_x, grad_weight, grad_bias]
        });
    }
}

#[derive(Debug)]
struct NormLinearBackward;

#[derive(Clone, Debug)]
struct NormLinearState<T> {
    norm: NormState<T>,
    beta: T,
    weight: T,
    precision: Precision,
}

impl<B: LinearKernels> Backward<B, 5> for NormLinearBackward {
    type State = NormLinearState<FloatTensor<B>>;

    /// As for [`LinearBackward`] with `a = norm(x)`, and `da` passed on to the norm.
    fn backward(self, ops: Ops<Self::State, 5>, grads: &mut Gradients, _checkpointer: &mut Checkpointer) {
        register::<B, _, 5>(ops, grads, |NormLinearState { norm, beta, weight, precision }, grad, needed| {
            let [of_x, of_gamma, of_beta, of_weight, of_bias] = needed;
            let grad_bias = of_bias.then(|| B::sum_rows(grad.clone()));
            let grad_weight = of_weight.then(|| {
                let (normal, _statistics) = B::norm_output([norm.x.clone(), norm.gamma.clone(), beta]);
                grad_of_weight::<B>(precision, normal, grad.clone())
            });
            let [grad_x, grad_gamma, grad_beta] = if of_x || of_gamma || of_beta {
                B::norm_backward(norm, grad_of_input::<B>(precision, grad, weight)).map(Some)
            } else {
                [None, None, None]
            };
            [grad_x, grad_gamma, grad_beta, grad_weight, grad_bias]
        });
    }
}

/// `x^T grad`: `[I, O]`
fn grad_of_weight<B: MatmulKernels>(precision: Precision, x: FloatTensor<B>, grad: FloatTensor<B>) -> FloatTensor<B> {
    B::matmul(precision, B::float_swap_dims(rows::<B>(x), 0, 1), rows::<B>(grad))
}

/// `grad W^T`: `[B, N, O] -> [B, N, I]`
fn grad_of_input<B: MatmulKernels>(
    precision: Precision,
    grad: FloatTensor<B>,
    weight: FloatTensor<B>,
) -> FloatTensor<B> {
    let [batch, count, _] = grad.shape().dims();
    let [inputs, _] = weight.shape().dims();
    let product = B::matmul(precision, rows::<B>(grad), B::float_swap_dims(weight, 0, 1));
    B::float_reshape(product, Shape::new([batch, count, inputs]))
}
