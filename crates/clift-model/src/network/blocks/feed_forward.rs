//! The feed-forward network of every block, and GELU with an exact gradient on every device.

use burn::module::Module;
use burn::nn::{LayerNorm, Linear};
use burn::tensor::{Tensor, activation};

use crate::network::init::Init;
use crate::ops::linear::{gelu_linear, linear, norm_linear};

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
        let hidden = norm_linear(norm, &self.up, x);
        match self.activation {
            Activation::Gelu => gelu_linear(&self.down, hidden),
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
        gelu_linear(&Linear { weight, bias }, x.reshape([1, dims.iter().product(), 1])).reshape(dims)
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
