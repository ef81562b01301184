//! Layer normalization and its gradient on every backend. Every norm of the model precedes a linear layer;
//! [`norm_linear`](crate::ops::linear::norm_linear) is the operation of both.
// B scenes, N tokens, D width

use burn::backend::tensor::FloatTensor;
use burn::backend::{Backend, Flex, TensorMetadata};
use burn::tensor::Shape;
use clift_kernels::{InstructionSet, layer_norm_backward, layer_norm_forward};

use crate::ops::flex::{contiguous, is_native, tensor, values};

/// Added to the variance, as in PyTorch.
pub const EPSILON: f64 = 1e-5;

/// `(x - mean) / sqrt(variance + 1e-5) * gamma + beta` over the last dimension, and its gradient. The default
/// implementations run on every backend.
pub trait LayerNormKernels: Backend {
    /// Computes the output from `x`, `gamma` and `beta`, and [`NormState::statistics`] if the native kernel runs.
    fn norm_output(inputs: [FloatTensor<Self>; 3]) -> (FloatTensor<Self>, Option<FloatTensor<Self>>) {
        (composed_output::<Self>(inputs), None)
    }

    /// Computes the gradients of `x`, `gamma` and `beta`.
    fn norm_backward(state: NormState<FloatTensor<Self>>, grad: FloatTensor<Self>) -> [FloatTensor<Self>; 3] {
        composed_backward::<Self>(state, grad)
    }
}

/// Inputs and saved results of the forward pass, for the backward.
#[derive(Clone, Debug)]
pub struct NormState<T> {
    /// Input, `[B, N, D]`.
    pub x: T,
    /// Scale, `[D]`.
    pub gamma: T,
    /// Mean and inverse deviation of every row, `[BN, 2]`, if the native kernel computed them.
    pub statistics: Option<T>,
}

/// Returns `(x - mean) / deviation` and `1 / deviation`.
fn normal<B: Backend>(x: FloatTensor<B>) -> (FloatTensor<B>, FloatTensor<B>) {
    let centered = B::float_sub(x.clone(), mean::<B>(x));
    let variance = mean::<B>(B::float_mul(centered.clone(), centered.clone()));
    let inverse = B::float_recip(B::float_sqrt(B::float_add_scalar(variance, EPSILON.into())));
    (B::float_mul(centered, inverse.clone()), inverse)
}

/// `[B, N, D] -> [B, N, 1]`
fn mean<B: Backend>(x: FloatTensor<B>) -> FloatTensor<B> {
    let [_, _, dim] = x.shape().dims();
    B::float_mul_scalar(B::float_sum_dim(x, 2), (1.0 / dim as f64).into())
}

/// `[D] -> [1, 1, D]`
fn row<B: Backend>(x: FloatTensor<B>) -> FloatTensor<B> {
    let [dim] = x.shape().dims();
    B::float_reshape(x, Shape::new([1, 1, dim]))
}

fn composed_output<B: Backend>([x, gamma, beta]: [FloatTensor<B>; 3]) -> FloatTensor<B> {
    B::float_add(B::float_mul(normal::<B>(x).0, row::<B>(gamma)), row::<B>(beta))
}

/// Computes the gradients. With `y` the normalized rows and `g = dO gamma`: `dx = (g - mean(g) - y mean(g y)) / deviation`,
/// `dgamma = sum(dO y)`, `dbeta = sum(dO)`.
fn composed_backward<B: Backend>(state: NormState<FloatTensor<B>>, grad: FloatTensor<B>) -> [FloatTensor<B>; 3] {
    let NormState { x, gamma, .. } = state;
    let [batch, count, dim] = x.shape().dims();
    let (normal, inverse) = normal::<B>(x);
    let product = B::float_mul(grad.clone(), normal.clone());
    let over_rows = |x: FloatTensor<B>| {
        let sum = B::float_sum_dim(B::float_reshape(x, Shape::new([batch * count, dim])), 0);
        B::float_reshape(sum, Shape::new([dim]))
    };
    let (grad_gamma, grad_beta) = (over_rows(product), over_rows(grad.clone()));
    let slope = B::float_mul(grad, row::<B>(gamma));
    let along = B::float_mul(normal.clone(), mean::<B>(B::float_mul(slope.clone(), normal)));
    let grad_x = B::float_mul(B::float_sub(B::float_sub(slope.clone(), mean::<B>(slope)), along), inverse);
    [grad_x, grad_gamma, grad_beta]
}

impl LayerNormKernels for Flex {
    fn norm_output(inputs: [FloatTensor<Self>; 3]) -> (FloatTensor<Self>, Option<FloatTensor<Self>>) {
        if !is_native(&inputs[0]) {
            return (composed_output::<Self>(inputs), None);
        }
        let [batch, count, dim] = inputs[0].shape().dims();
        let inputs = inputs.map(contiguous);
        let mut output = vec![0.0; batch * count * dim];
        let mut statistics = vec![0.0; batch * count * 2];
        let (pairs, _) = statistics.as_chunks_mut();
        let slices = inputs.each_ref().map(values);
        layer_norm_forward(InstructionSet::detected(), EPSILON as f32, slices, &mut output, pairs);
        (tensor(output, [batch, count, dim]), Some(tensor(statistics, [batch * count, 2])))
    }

    fn norm_backward(state: NormState<FloatTensor<Self>>, grad: FloatTensor<Self>) -> [FloatTensor<Self>; 3] {
        let Some(statistics) = &state.statistics else {
            return composed_backward::<Self>(state, grad);
        };
        let [batch, count, dim] = state.x.shape().dims();
        let [x, gamma, grad] = [state.x, state.gamma, grad].map(contiguous);
        let mut grads = [batch * count * dim, dim, dim].map(|len| vec![0.0; len]);
        let inputs = [values(&x), values(&gamma), values(&grad)];
        let (pairs, _) = values(statistics).as_chunks();
        layer_norm_backward(InstructionSet::detected(), inputs, pairs, grads.each_mut().map(|grad| &mut grad[..]));
        let [grad_x, grad_gamma, grad_beta] = grads;
        [tensor(grad_x, [batch, count, dim]), tensor(grad_gamma, [dim]), tensor(grad_beta, [dim])]
    }
}
#[cfg(feature = "ndarray")]
impl LayerNormKernels for burn::backend::NdArray {}
#[cfg(feature = "wgpu")]
impl LayerNormKernels for burn::backend::Cube {}

#[cfg(test)]
mod tests {
    use burn::module::Param;
    use burn::nn::Linear;
    use burn::tensor::{DType, Device, Tensor};

    use crate::ops::linear::norm_then_linear;
    use crate::testing::{
        assert_close, check_gradients, check_native, cpu_devices, devices, output_and_gradients, random,
    };

    /// Applies a norm before an identity layer; gamma and beta are `[1, 1, D]`.
    fn norm(x: Tensor<3>, gamma: Tensor<3>, beta: Tensor<3>) -> Tensor<3> {
        let [_, _, dim] = x.dims();
        let (device, dtype) = (x.device(), x.dtype());
        let identity = Linear {
            weight: Param::from_tensor(Tensor::<2>::eye(dim, &device).cast(dtype)),
            bias: Some(Param::from_tensor(Tensor::<1>::zeros([dim], &device).cast(dtype))),
        };
        norm_then_linear(x, gamma.reshape([dim]), beta.reshape([dim]), &identity)
    }

    #[test]
    fn gradients_equal_central_differences_in_f64() {
        for device in cpu_devices() {
            let inputs = [random([2, 5, 8], 1, &device), random([1, 1, 8], 2, &device), random([1, 1, 8], 3, &device)];
            check_gradients(inputs, |[x, gamma, beta]| norm(x, gamma, beta), 1e-6);
        }
    }

    #[test]
    fn native_kernels_equal_f64() {
        let device = Device::flex();
        let inputs =
            [([3, 7, 37], 1), ([1, 1, 37], 2), ([1, 1, 37], 3)].map(|(shape, seed)| random(shape, seed, &device));
        check_native(inputs, random([3, 7, 37], 4, &device), |[x, gamma, beta]| norm(x, gamma, beta), 1e-5);
    }

    #[test]
    fn a_constant_row_gives_beta_and_finite_gradients() {
        for device in devices() {
            let [gamma, beta] = [1, 2].map(|seed| random([1, 1, 12], seed, &device).cast(DType::F32));
            let x = Tensor::<3>::full([1, 2, 12], 3.0, &device);
            let cotangent = random([1, 2, 12], 3, &device).cast(DType::F32);
            let inputs = [x, gamma, beta.clone()];
            let (output, grads) = output_and_gradients(inputs, cotangent, |[x, gamma, beta]| norm(x, gamma, beta));
            assert_close(&output, &beta.expand([1, 2, 12]), 1e-4);
            assert!(grads.into_iter().all(|grad| grad.is_finite().all().into_scalar::<bool>()));
        }
    }
}
