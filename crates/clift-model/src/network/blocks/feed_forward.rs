//! The feed-forward network of every block.

use burn::module::Module;
use burn::nn::{LayerNorm, Linear};
use burn::tensor::{Tensor, activation};

use crate::network::init::Init;
use crate::ops::linear::{gelu_linear, linear, norm_linear};

/// The activation between the two layers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Activation {
    Gelu,
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
    /// Makes a network with PyTorch's initialization.
    pub fn new(activation: Activation, dim: usize, hidden: usize, init: &mut Init) -> Self {
        Self { up: init.linear(dim, hidden), down: init.linear(hidden, dim), activation }
    }

    /// Applies `norm` and the network to every token.
    pub fn forward(&self, norm: &LayerNorm, x: Tensor<3>) -> Tensor<3> {
        let hidden = norm_linear(norm, &self.up, x);
        match self.activation {
            Activation::Gelu => gelu_linear(&self.down, hidden),
            Activation::Relu => linear(&self.down, activation::relu(hidden)),
        }
    }
}
