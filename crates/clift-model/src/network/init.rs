//! Initial weights, drawn on the host: a seed gives the same network on every device.
//!
//! The distributions are PyTorch's: linear layers uniform in `+-1/sqrt(inputs)`, packed attention
//! projections Xavier-uniform with zero bias. Departs from the released code, whose blocks start as
//! copies of each other: here each is drawn on its own.

use burn::module::Param;
use burn::nn::{LayerNorm, LayerNormConfig, Linear, RmsNorm, RmsNormConfig};
use burn::tensor::{Device, Tensor, TensorData};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Makes layers on a device, in a fixed order, from one stream of random numbers.
#[derive(Debug)]
pub struct Init {
    device: Device,
    rng: ChaCha8Rng,
}

impl Init {
    /// Starts the stream of `seed`.
    pub fn new(seed: u64, device: &Device) -> Self {
        Self { device: device.clone(), rng: ChaCha8Rng::seed_from_u64(seed) }
    }

    /// A linear layer with bias, both uniform in `+-1/sqrt(inputs)`.
    pub fn linear(&mut self, inputs: usize, outputs: usize) -> Linear {
        let bound = 1.0 / (inputs as f64).sqrt();
        Linear { weight: self.uniform([inputs, outputs], bound), bias: Some(self.uniform([outputs], bound)) }
    }

    /// A packed attention projection of `parts` matrices `[dim, dim]`, Xavier-uniform over the
    /// `[dim, 3 dim]` matrix they are part of, with zero bias.
    pub fn attention_in(&mut self, dim: usize, parts: usize) -> Linear {
        let bound = (6.0 / (4 * dim) as f64).sqrt();
        Linear { weight: self.uniform([dim, parts * dim], bound), bias: Some(self.zeros([parts * dim])) }
    }

    /// The projection after attention: uniform weight, zero bias.
    pub fn attention_out(&mut self, dim: usize) -> Linear {
        let bound = 1.0 / (dim as f64).sqrt();
        Linear { weight: self.uniform([dim, dim], bound), bias: Some(self.zeros([dim])) }
    }

    /// A linear layer without bias that starts as zero (`W_z` of paper equation 4).
    pub fn zero_linear(&mut self, inputs: usize, outputs: usize) -> Linear {
        Linear { weight: self.zeros([inputs, outputs]), bias: None }
    }

    /// A linear layer with bias, both zero at the start: the gate of the released condensers.
    pub fn zero_linear_with_bias(&mut self, inputs: usize, outputs: usize) -> Linear {
        Linear { bias: Some(self.zeros([outputs])), ..self.zero_linear(inputs, outputs) }
    }

    /// An RMS norm with epsilon 1e-5.
    pub fn rms_norm(&mut self, dim: usize) -> RmsNorm {
        RmsNormConfig::new(dim).init(&self.device)
    }

    /// A layer norm with epsilon 1e-5.
    pub fn layer_norm(&mut self, dim: usize) -> LayerNorm {
        LayerNormConfig::new(dim).init(&self.device)
    }

    fn uniform<const D: usize>(&mut self, shape: [usize; D], bound: f64) -> Param<Tensor<D>> {
        let values: Vec<f32> =
            (0..shape.iter().product()).map(|_| self.rng.random_range(-bound..bound) as f32).collect();
        Param::from_tensor(Tensor::from_data(TensorData::new(values, shape), &self.device))
    }

    fn zeros<const D: usize>(&self, shape: [usize; D]) -> Param<Tensor<D>> {
        Param::from_tensor(Tensor::zeros(shape, &self.device))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{devices, to_vec};

    #[test]
    fn a_seed_gives_the_same_weights_on_every_device_and_another_seed_others() {
        let weights = |seed, device: &Device| to_vec(Init::new(seed, device).linear(16, 8).weight.val());
        let all: Vec<_> = devices().iter().map(|device| weights(7, device)).collect();
        assert!(all.windows(2).all(|pair| pair[0] == pair[1]));
        assert_ne!(all[0], weights(8, &devices()[0]));
    }

    #[test]
    fn weights_fill_their_interval() {
        let device = Device::flex();
        let mut init = Init::new(0, &device);
        let spread = |values: Vec<f64>| values.iter().fold(0.0_f64, |largest, value| largest.max(value.abs()));
        let bound = 1.0 / 64.0_f64.sqrt();
        let largest = spread(to_vec(init.linear(64, 64).weight.val()));
        assert!(largest <= bound && largest > 0.99 * bound, "{largest}");
        let bound = (6.0 / 256.0_f64).sqrt();
        let largest = spread(to_vec(init.attention_in(64, 3).weight.val()));
        assert!(largest <= bound && largest > 0.99 * bound, "{largest}");
    }
}
