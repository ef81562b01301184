//! The feed-forward network of every block.

use burn::module::Module;
use burn::nn::{LayerNorm, Linear};
use burn::tensor::{Tensor, activation};

use crate::network::init::Init;
use crate::ops::linear::{gelu_linear, linear, norm_linear};

/// The activation between the two layers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Activation {
    /// `x * Phi(x)`
    Gelu,
    /// `max(x, 0)`, in the condenser of the released networks.
    Relu,
}

/// `down(activation(up(norm(x))))`; the norm belongs to the block.
#[derive(Module, Debug)]
pub struct FeedForward {
    up: Linear,
    down: Linear,
    #[module(skip)]
    activation: Activation,
}

impl FeedForward {
    /// Makes a network with GELU and PyTorch's initialization.
    pub fn new(dim: usize, hidden: usize, init: &mut Init) -> Self {
        Self::with(Activation::Gelu, dim, hidden, init)
    }

    /// Makes a network with another activation.
    pub fn with(activation: Activation, dim: usize, hidden: usize, init: &mut Init) -> Self {
        Self { up: init.linear(dim, hidden), down: init.linear(hidden, dim), activation }
    }

    /// Applies `norm` and the network to every token.
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

    use super::*;
    use crate::testing::{Fixture, assert_close, devices};

    /// GELU alone: `gelu_linear` with the identity as its layer.
    fn gelu(x: Tensor<3>) -> Tensor<3> {
        let like = x.clone().detach().slice([0..1, 0..1, 0..1]).reshape([1, 1]);
        let weight = Param::from_tensor(like.ones_like());
        let bias = Some(Param::from_tensor(like.zeros_like().reshape([1])));
        let dims = x.dims();
        gelu_linear(&Linear { weight, bias }, x.reshape([1, dims.iter().product(), 1])).reshape(dims)
    }

    #[test]
    fn gelu_and_its_derivative_equal_pytorch() {
        let fixture = Fixture::open("gelu");
        for device in devices() {
            let device = device.autodiff();
            let [x, expected, slope] = ["input.x", "output.gelu", "output.derivative"]
                .map(|name| fixture.tensor::<1>(name, &device).unsqueeze::<3>());
            let x = x.require_grad();
            let y = gelu(x.clone());
            assert_close(&y.clone().inner(), &expected.inner(), 1e-6);
            assert_close(&x.grad(&y.sum().backward()).expect("tracked"), &slope.inner(), 2e-6);
        }
    }
}
