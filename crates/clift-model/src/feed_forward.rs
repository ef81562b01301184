//! The feed-forward network of every block, and GELU with an exact gradient on every device.
#![expect(deprecated, reason = "upstream retires ndarray in favour of flex; it stays as an independent check")]

use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind, unary};
use burn::backend::ops::ActivationOps;
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, Dispatch, Flex, NdArray, backend_extension};
use burn::module::Module;
use burn::nn::Linear;
use burn::tensor::Tensor;

use crate::Init;

/// `GELU(x) = x * Phi(x)` with the normal distribution function `Phi` (erf, not the tanh
/// approximation), differentiated exactly. Burn 0.22 differentiates the approximation on GPUs.
///
/// # Shapes
/// - `x` and the result: any
pub fn gelu<const D: usize>(x: Tensor<D>) -> Tensor<D> {
    Tensor::from_dispatch(<Dispatch as GeluOps>::exact_gelu(x.into_dispatch()))
}

/// The operation behind [`gelu`] on a device.
#[backend_extension(Flex, NdArray, Cube: cfg(feature = "wgpu"), Autodiff)]
pub trait GeluOps: Backend {
    /// See [`gelu`].
    fn exact_gelu(x: FloatTensor<Self>) -> FloatTensor<Self> {
        Self::float_mul(x.clone(), normal_cdf::<Self>(x))
    }
}

/// The gradient of [`gelu`] on a device.
pub trait GeluGradient: Backend {
    /// `grad * (Phi(x) + x * phi(x))` with the normal density `phi`.
    fn exact_gelu_backward(x: FloatTensor<Self>, grad: FloatTensor<Self>) -> FloatTensor<Self> {
        let density = Self::float_exp(Self::float_mul_scalar(Self::float_mul(x.clone(), x.clone()), (-0.5).into()));
        let density = Self::float_mul_scalar(density, (1.0 / (2.0 * std::f64::consts::PI).sqrt()).into());
        let slope = Self::float_add(normal_cdf::<Self>(x.clone()), Self::float_mul(x, density));
        Self::float_mul(grad, slope)
    }
}

fn normal_cdf<B: Backend>(x: FloatTensor<B>) -> FloatTensor<B> {
    let erf = B::float_erf(B::float_mul_scalar(x, std::f64::consts::FRAC_1_SQRT_2.into()));
    B::float_mul_scalar(B::float_add_scalar(erf, 1.0.into()), 0.5.into())
}

impl GeluOps for Flex {
    fn exact_gelu(x: FloatTensor<Self>) -> FloatTensor<Self> {
        // One pass, and exact on this device.
        <Self as ActivationOps<Self>>::gelu(x)
    }
}
impl GeluGradient for Flex {
    fn exact_gelu_backward(x: FloatTensor<Self>, grad: FloatTensor<Self>) -> FloatTensor<Self> {
        <Self as ActivationOps<Self>>::gelu_backward(x, grad)
    }
}
impl GeluOps for NdArray {}
impl GeluGradient for NdArray {}
#[cfg(feature = "wgpu")]
impl GeluOps for burn::backend::Cube {}
#[cfg(feature = "wgpu")]
impl GeluGradient for burn::backend::Cube {}

impl<B: GeluOps + GeluGradient, C: CheckpointStrategy> GeluOps for Autodiff<B, C> {
    fn exact_gelu(x: FloatTensor<Self>) -> FloatTensor<Self> {
        let (x, node) = x.into_parts();
        match GeluBackward.prepare::<C>([node]).compute_bound().stateful() {
            OpsKind::Tracked(prep) => prep.finish(x.clone(), B::exact_gelu(x)),
            OpsKind::UnTracked(prep) => prep.finish(B::exact_gelu(x)),
        }
    }
}

#[derive(Debug)]
struct GeluBackward;

impl<B: GeluGradient> Backward<B, 1> for GeluBackward {
    type State = FloatTensor<B>;

    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _checkpointer: &mut Checkpointer) {
        unary::<B, _>(ops.parents, ops.node, grads, |grad| B::exact_gelu_backward(ops.state, grad));
    }
}

/// `down(GELU(up(x)))`.
#[derive(Module, Debug)]
pub struct FeedForward {
    up: Linear,
    down: Linear,
}

impl FeedForward {
    /// Makes the network with PyTorch's initialisation.
    pub fn new(dim: usize, hidden: usize, init: &mut Init) -> Self {
        Self { up: init.linear(dim, hidden), down: init.linear(hidden, dim) }
    }

    /// Maps every token on its own.
    ///
    /// # Shapes
    /// - `x` and the result: `[batch, count, dim]`
    pub fn forward(&self, x: Tensor<3>) -> Tensor<3> {
        self.down.forward(gelu(self.up.forward(x)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{Fixture, assert_close, check_gradients, cpu_devices, devices, random};

    #[test]
    fn values_and_slopes_equal_pytorchs_from_minus_30_to_30() {
        let fixture = Fixture::open("gelu");
        for device in devices() {
            let device = device.autodiff();
            let x = fixture.tensor::<1>("input.x", &device).require_grad();
            let y = gelu(x.clone());
            // Against values up to 30 in f32.
            assert_close(&y.clone().inner(), &fixture.tensor::<1>("output.gelu", &device).inner(), 1e-6);
            let slope = x.grad(&y.sum().backward()).expect("tracked");
            assert_close(&slope, &fixture.tensor::<1>("output.derivative", &device).inner(), 2e-6);
        }
    }

    #[test]
    fn gradients_equal_central_differences_in_f64() {
        for device in cpu_devices() {
            check_gradients([random([2, 5, 8], 1, &device) * 3.0], |[x]| gelu(x), 1e-6);
        }
    }
}
