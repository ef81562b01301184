//! Linear layers as one operation, on their own or behind a GELU.
//!
//! `linear(gelu(x))` keeps `x` and computes `gelu(x)` again in the backward, which costs one pass
//! and saves the widest activation of a transformer block.
#![expect(deprecated, reason = "upstream retires ndarray in favour of flex; it stays as an independent check")]
// B scenes, N rows of a scene, I inputs, O outputs

use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, Dispatch, Flex, NdArray, TensorMetadata, backend_extension};
use burn::nn::Linear;
use burn::tensor::{Shape, Tensor, assert_shape};
use clift_kernels::linear::{self as kernel, Matrix};
use clift_kernels::{InstructionSet, layer_norm};

use crate::feed_forward::GeluKernels;
use crate::flex::{contiguous, is_native, tensor, values};

/// `x W + b` of a layer with a bias.
///
/// # Shapes
/// - `x`: `[batch, count, inputs]`
/// - returns `[batch, count, outputs]`
///
/// # Panics
/// When the layer has no bias.
pub fn linear(layer: &Linear, x: Tensor<3>) -> Tensor<3> {
    apply(layer, x, false)
}

/// `gelu(x) W + b` with the exact GELU, see [`gelu`](crate::feed_forward::gelu).
///
/// # Shapes
/// - `x`: `[batch, count, inputs]`
/// - returns `[batch, count, outputs]`
///
/// # Panics
/// When the layer has no bias.
pub fn linear_of_gelu(layer: &Linear, x: Tensor<3>) -> Tensor<3> {
    apply(layer, x, true)
}

fn apply(layer: &Linear, x: Tensor<3>, of_gelu: bool) -> Tensor<3> {
    let weight = layer.weight.val();
    let bias = layer.bias.as_ref().expect("the layer has a bias").val();
    let [inputs, _outputs] = weight.dims();
    assert_shape!(x, [.., inputs]);
    let [x, weight, bias] = [x.into_dispatch(), weight.into_dispatch(), bias.into_dispatch()];
    Tensor::from_dispatch(<Dispatch as LinearOps>::linear_layer(x, weight, bias, of_gelu))
}

/// The operation behind [`linear`] and [`linear_of_gelu`] on a device.
#[backend_extension(Flex, NdArray, Cube: cfg(feature = "wgpu"), Autodiff)]
pub trait LinearOps: Backend {
    /// See [`linear`].
    fn linear_layer(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        of_gelu: bool,
    ) -> FloatTensor<Self>;
}

/// The parts of the operation on a device. The bodies here run on every one of them.
pub trait LinearKernels: GeluKernels {
    /// `x W + b`: `[B, N, I] -> [B, N, O]`
    fn linear_output(x: FloatTensor<Self>, weight: FloatTensor<Self>, bias: FloatTensor<Self>) -> FloatTensor<Self> {
        output::<Self>(x, weight, bias)
    }

    /// Sum over rows: `[B, N, O] -> [O]`
    fn sum_rows(x: FloatTensor<Self>) -> FloatTensor<Self> {
        sum::<Self>(x)
    }
}

fn output<B: Backend>(x: FloatTensor<B>, weight: FloatTensor<B>, bias: FloatTensor<B>) -> FloatTensor<B> {
    let [batch, count, _] = x.shape().dims();
    let [_, outputs] = weight.shape().dims();
    let product = B::float_matmul(rows::<B>(x), weight); // [BN, O]
    let bias = B::float_expand(B::float_reshape(bias, Shape::new([1, outputs])), product.shape());
    B::float_reshape(B::float_add(product, bias), Shape::new([batch, count, outputs]))
}

fn sum<B: Backend>(x: FloatTensor<B>) -> FloatTensor<B> {
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
    fn linear_output(x: FloatTensor<Self>, weight: FloatTensor<Self>, bias: FloatTensor<Self>) -> FloatTensor<Self> {
        if !is_native(&x) {
            return output::<Self>(x, weight, bias);
        }
        let [batch, count, inputs] = x.shape().dims();
        let [_, outputs] = weight.shape().dims();
        let [x, weight, bias] = [x, weight, bias].map(contiguous);
        let mut output = vec![0.0; batch * count * outputs];
        kernel::forward(
            [batch * count, inputs, outputs],
            Matrix::contiguous(values(&x), inputs),
            Matrix::contiguous(values(&weight), outputs),
            Some(values(&bias)),
            &mut output,
        );
        tensor(output, [batch, count, outputs])
    }

    fn sum_rows(x: FloatTensor<Self>) -> FloatTensor<Self> {
        if !is_native(&x) {
            return sum::<Self>(x);
        }
        let [_, _, outputs] = x.shape().dims();
        let mut sum = vec![0.0; outputs];
        layer_norm::sum_rows(InstructionSet::detected(), values(&contiguous(x)), &mut sum);
        tensor(sum, [outputs])
    }
}

impl LinearKernels for NdArray {}
#[cfg(feature = "wgpu")]
impl LinearKernels for burn::backend::Cube {}

fn forward<B: LinearKernels>(
    x: FloatTensor<B>,
    weight: FloatTensor<B>,
    bias: FloatTensor<B>,
    of_gelu: bool,
) -> FloatTensor<B> {
    B::linear_output(if of_gelu { B::gelu_output(x) } else { x }, weight, bias)
}

impl<B: LinearOps + LinearKernels, C: CheckpointStrategy> LinearOps for Autodiff<B, C> {
    fn linear_layer(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        of_gelu: bool,
    ) -> FloatTensor<Self> {
        let ((x, x_node), (weight, weight_node), (bias, bias_node)) =
            (x.into_parts(), weight.into_parts(), bias.into_parts());
        match LinearBackward.prepare::<C>([x_node, weight_node, bias_node]).compute_bound().stateful() {
            OpsKind::Tracked(prep) => {
                let output = forward::<B>(x.clone(), weight.clone(), bias, of_gelu);
                prep.finish(LinearState { x, weight, of_gelu }, output)
            }
            OpsKind::UnTracked(prep) => prep.finish(forward::<B>(x, weight, bias, of_gelu)),
        }
    }
}

#[derive(Debug)]
struct LinearBackward;

#[derive(Clone, Debug)]
struct LinearState<T> {
    x: T,
    weight: T,
    of_gelu: bool,
}

impl<B: LinearKernels> Backward<B, 3> for LinearBackward {
    type State = LinearState<FloatTensor<B>>;

    /// With `a = x` or `gelu(x)`: `dW = a^T dO`, `db = sum dO`, `da = dO W^T`.
    fn backward(self, ops: Ops<Self::State, 3>, grads: &mut Gradients, _checkpointer: &mut Checkpointer) {
        let grad = grads.consume::<B>(&ops.node);
        let LinearState { x, weight, of_gelu } = ops.state;
        let [of_x, of_weight, of_bias] = ops.parents;
        if let Some(node) = of_bias {
            grads.register::<B>(node.id, B::sum_rows(grad.clone()));
        }
        if let Some(node) = of_weight {
            let activation = if of_gelu { B::gelu_output(x.clone()) } else { x.clone() };
            let transposed = B::float_swap_dims(rows::<B>(activation), 0, 1);
            grads.register::<B>(node.id, B::float_matmul(transposed, rows::<B>(grad.clone())));
        }
        if let Some(node) = of_x {
            let product = B::float_matmul(rows::<B>(grad), B::float_swap_dims(weight, 0, 1));
            let grad = B::float_reshape(product, x.shape());
            grads.register::<B>(node.id, if of_gelu { B::gelu_grad(x, grad) } else { grad });
        }
    }
}

macro_rules! composed {
    ($backend:ty) => {
        impl LinearOps for $backend {
            fn linear_layer(
                x: FloatTensor<Self>,
                weight: FloatTensor<Self>,
                bias: FloatTensor<Self>,
                of_gelu: bool,
            ) -> FloatTensor<Self> {
                forward::<Self>(x, weight, bias, of_gelu)
            }
        }
    };
}

composed!(Flex);
composed!(NdArray);
#[cfg(feature = "wgpu")]
composed!(burn::backend::Cube);
