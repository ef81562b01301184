//! GELU with exact gradient on every backend.

use burn::backend::tensor::FloatTensor;
use burn::backend::{Backend, Flex, TensorMetadata};
use clift_kernels::{InstructionSet, gelu_backward, gelu_forward};

use crate::ops::flex::{contiguous, is_native, tensor, values, values_mut};

/// GELU, `x * Phi(x)` with the normal distribution function `Phi` (erf, not the tanh approximation), and its exact
/// gradient; Burn 0.22 differentiates the approximation on GPUs. The default implementations run on every backend.
pub trait GeluKernels: Backend {
    fn gelu_output(x: FloatTensor<Self>) -> FloatTensor<Self> {
        composed_output::<Self>(x)
    }

    /// Computes `grad * (Phi(x) + x * phi(x))` with the normal density `phi`.
    fn gelu_grad(x: FloatTensor<Self>, grad: FloatTensor<Self>) -> FloatTensor<Self> {
        composed_grad::<Self>(x, grad)
    }
}

fn composed_output<B: Backend>(x: FloatTensor<B>) -> FloatTensor<B> {
    B::float_mul(x.clone(), normal_cdf::<B>(x))
}

fn composed_grad<B: Backend>(x: FloatTensor<B>, grad: FloatTensor<B>) -> FloatTensor<B> {
    let density = B::float_exp(B::float_mul_scalar(B::float_mul(x.clone(), x.clone()), (-0.5).into()));
    let density = B::float_mul_scalar(density, (1.0 / (2.0 * std::f64::consts::PI).sqrt()).into());
    B::float_mul(grad, B::float_add(normal_cdf::<B>(x.clone()), B::float_mul(x, density)))
}

fn normal_cdf<B: Backend>(x: FloatTensor<B>) -> FloatTensor<B> {
    let erf = B::float_erf(B::float_mul_scalar(x, std::f64::consts::FRAC_1_SQRT_2.into()));
    B::float_mul_scalar(B::float_add_scalar(erf, 1.0.into()), 0.5.into())
}

impl GeluKernels for Flex {
    fn gelu_output(x: FloatTensor<Self>) -> FloatTensor<Self> {
        if !is_native(&x) {
            return composed_output::<Self>(x);
        }
        let mut to = vec![0.0; x.shape().num_elements()];
        let shape = x.shape();
        gelu_forward(InstructionSet::detected(), values(&contiguous(x)), &mut to);
        tensor(to, shape)
    }

    fn gelu_grad(x: FloatTensor<Self>, grad: FloatTensor<Self>) -> FloatTensor<Self> {
        if !is_native(&x) {
            return composed_grad::<Self>(x, grad);
        }
        let mut grad = contiguous(grad);
        gelu_backward(InstructionSet::detected(), values(&contiguous(x)), values_mut(&mut grad));
        grad
    }
}

#[cfg(feature = "ndarray")]
impl GeluKernels for burn::backend::NdArray {}
#[cfg(feature = "wgpu")]
impl GeluKernels for burn::backend::Cube {}
