//! The feed-forward network of every block, and GELU with an exact gradient on every device.
#![expect(deprecated, reason = "upstream retires ndarray in favour of flex; it stays as an independent check")]

use burn::backend::tensor::FloatTensor;
use burn::backend::{Backend, Flex, NdArray, TensorMetadata};
use burn::module::Module;
use burn::nn::{LayerNorm, Linear};
use burn::tensor::{Tensor, activation};
use clift_kernels::{InstructionSet, gelu};

use crate::Init;
use crate::flex::{contiguous, is_native, tensor, values, values_mut};
use crate::linear::{linear, linear_of_gelu, linear_of_norm};

/// GELU on a device, `x * Phi(x)` with the normal distribution function `Phi` (erf, not the tanh
/// approximation), and its exact gradient: Burn 0.22 differentiates the approximation on GPUs.
/// The bodies here run on every device.
pub trait GeluKernels: Backend {
    /// `x * Phi(x)`
    fn gelu_output(x: FloatTensor<Self>) -> FloatTensor<Self> {
        output::<Self>(x)
    }

    /// `grad * (Phi(x) + x * phi(x))` with the normal density `phi`.
    fn gelu_grad(x: FloatTensor<Self>, grad: FloatTensor<Self>) -> FloatTensor<Self> {
        backward::<Self>(x, grad)
    }
}

fn output<B: Backend>(x: FloatTensor<B>) -> FloatTensor<B> {
    B::float_mul(x.clone(), normal_cdf::<B>(x))
}

fn backward<B: Backend>(x: FloatTensor<B>, grad: FloatTensor<B>) -> FloatTensor<B> {
    let density = B::float_exp(B::float_mul_scalar(B::float_mul(x.clone(), x.clone()), (-0.5).into()));
    let density = B::float_mul_scalar(density, (1.0 / (2.0 * std::f64::consts::PI).sqrt()).into());
    let slope = B::float_add(normal_cdf::<B>(x.clone()), B::float_mul(x, density));
    B::float_mul(grad, slope)
}

fn normal_cdf<B: Backend>(x: FloatTensor<B>) -> FloatTensor<B> {
    let erf = B::float_erf(B::float_mul_scalar(x, std::f64::consts::FRAC_1_SQRT_2.into()));
    B::float_mul_scalar(B::float_add_scalar(erf, 1.0.into()), 0.5.into())
}

impl GeluKernels for Flex {
    fn gelu_output(x: FloatTensor<Self>) -> FloatTensor<Self> {
        if !is_native(&x) {
            return output::<Self>(x);
        }
        let mut to = vec![0.0; x.shape().num_elements()];
        let shape = x.shape();
        gelu::forward(InstructionSet::detected(), values(&contiguous(x)), &mut to);
        tensor(to, shape)
    }

    fn gelu_grad(x: FloatTensor<Self>, grad: FloatTensor<Self>) -> FloatTensor<Self> {
        if !is_native(&x) {
            return backward::<Self>(x, grad);
        }
        let mut grad = contiguous(grad);
        gelu::backward(InstructionSet::detected(), values(&contiguous(x)), values_mut(&mut grad));
        grad
    }
}
impl GeluKernels for NdArray {}
#[cfg(feature = "wgpu")]
impl GeluKernels for burn::backend::Cube {}

/// What stands between the two layers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Activation {
    /// `x * Phi(x)`
    Gelu,
    /// `max(x, 0)`: in the condenser of the released networks.
    Relu,
}

/// `down(GELU(up(norm(x))))`; the norm is the block's.
#[derive(Module, Debug)]
pub struct FeedForward {
    up: Linear,
    down: Linear,
    #[module(skip)]
    activation: Activation,
}

impl FeedForward {
    /// Makes the network with PyTorch's initialisation.
    pub fn new(dim: usize, hidden: usize, init: &mut Init) -> Self {
        Self::with(Activation::Gelu, dim, hidden, init)
    }

    /// The same with another activation.
    pub fn with(activation: Activation, dim: usize, hidden: usize, init: &mut Init) -> Self {
        Self { up: init.linear(dim, hidden), down: init.linear(hidden, dim), activation }
    }

    /// Maps every normalised token on its own.
    ///
    /// # Shapes
    /// - `x` and the result: `[batch, count, dim]`
    pub fn forward(&self, norm: &LayerNorm, x: Tensor<3>) -> Tensor<3> {
        let hidden = linear_of_norm(norm, &self.up, x);
        match self.activation {
            Activation::Gelu => linear_of_gelu(&self.down, hidden),
            Activation::Relu => linear(&self.down, activation::relu(hidden)),
        }
    }
}

#[cfg(test)]
mod tests {
    use burn::module::Param;
    use burn::tensor::Device;

    use super::*;
    use crate::testing::{Fixture, assert_close, check_gradients, cpu_devices, devices, random};

    /// GELU on its own: behind it a layer that changes nothing.
    fn gelu(x: Tensor<3>) -> Tensor<3> {
        let device = x.device();
        let like = x.clone().detach().slice([0..1, 0..1, 0..1]).reshape([1, 1]);
        let weight = Param::from_tensor(like.ones_like());
        let bias = Some(Param::from_tensor(like.zeros_like().reshape([1])));
        assert_eq!(weight.val().device(), device);
        let dims = x.dims();
        linear_of_gelu(&Linear { weight, bias }, x.reshape([1, dims.iter().product(), 1])).reshape(dims)
    }

    #[test]
    fn values_and_slopes_equal_pytorchs_from_minus_30_to_30() {
        let fixture = Fixture::open("gelu");
        for device in devices() {
            let device = device.autodiff();
            let [x, expected, slope] = ["input.x", "output.gelu", "output.derivative"]
                .map(|name| fixture.tensor::<1>(name, &device).unsqueeze::<3>());
            let x = x.require_grad();
            let y = gelu(x.clone());
            // Against values up to 30 in f32.
            assert_close(&y.clone().inner(), &expected.inner(), 1e-6);
            assert_close(&x.grad(&y.sum().backward()).expect("tracked"), &slope.inner(), 2e-6);
        }
    }

    #[test]
    fn gradients_equal_central_differences_in_f64() {
        for device in cpu_devices() {
            check_gradients([random([2, 5, 8], 1, &device) * 3.0], |[x]| gelu(x), 1e-6);
        }
    }

    #[test]
    fn native_kernels_equal_f64() {
        let device = Device::flex();
        let x = random([3, 7, 5], 1, &device) * 4.0;
        let narrow = x.clone().cast(burn::tensor::DType::F32);
        assert_close(
            &gelu(narrow.clone()).cast(burn::tensor::DType::F64),
            &gelu(narrow.cast(burn::tensor::DType::F64)),
            1e-6,
        );
    }
}
