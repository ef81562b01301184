//! Initial weights, sampled on the host: a seed gives the same network on every device.
//!
//! The distributions are PyTorch's: linear layers uniform in `+-1/sqrt(inputs)`, packed attention projections
//! Xavier-uniform with zero bias. All blocks of the released code start with the same weights; here every block has its
//! own.

use burn::module::Param;
use burn::nn::{LayerNorm, LayerNormConfig, Linear, RmsNorm, RmsNormConfig};
use burn::tensor::{Device, Tensor, TensorData};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// A source of initialized layers on a device. All layers share one stream of random numbers.
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

    /// Makes a linear layer with bias, both uniform in `+-1/sqrt(inputs)`.
    pub fn linear(&mut self, inputs: usize, outputs: usize) -> Linear {
        let bound = 1.0 / (inputs as f64).sqrt();
        Linear { weight: self.uniform([inputs, outputs], bound), bias: Some(self.uniform([outputs], bound)) }
    }

    /// Makes a packed attention projection of `parts` matrices `[dim, dim]`: Xavier-uniform for the whole `[dim, 3 dim]`
    /// matrix of queries, keys and values, with zero bias.
    pub fn attention_in(&mut self, dim: usize, parts: usize) -> Linear {
        let bound = (6.0 / (4 * dim) as f64).sqrt();
        Linear { weight: self.uniform([dim, parts * dim], bound), bias: Some(self.zeros([parts * dim])) }
    }

    /// Makes the projection after attention: uniform weight, zero bias.
    pub fn attention_out(&mut self, dim: usize) -> Linear {
        let bound = 1.0 / (dim as f64).sqrt();
        Linear { weight: self.uniform([dim, dim], bound), bias: Some(self.zeros([dim])) }
    }

    /// Makes a linear layer of zeros without bias (`W_z` of equation 4).
    pub fn zero_linear(&mut self, inputs: usize, outputs: usize) -> Linear {
        Linear { weight: self.zeros([inputs, outputs]), bias: None }
    }

    /// Makes a linear layer of zeros with bias: the gate of the released condensers.
    pub fn zero_linear_with_bias(&mut self, inputs: usize, outputs: usize) -> Linear {
        Linear { bias: Some(self.zeros([outputs])), ..self.zero_linear(inputs, outputs) }
    }

    /// Makes an RMS norm with epsilon 1e-5.
    pub fn rms_norm(&mut self, dim: usize) -> RmsNorm {
        RmsNormConfig::new(dim).init(&self.device)
    }

    /// Makes a layer norm with epsilon 1e-5.
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
    fn weights_depend_on_the_seed_and_not_on_the_device() {
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
