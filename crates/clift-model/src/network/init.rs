//! Initial weights, sampled on the host: a seed gives the same network on every device.
//!
//! The distributions are PyTorch's: linear layers uniform in `+-1/sqrt(inputs)`, packed attention projections
//! Xavier-uniform with zero bias. The matrices of LVSM's network without biases are normal. All blocks of the released code
//! start with the same weights; here every block has its own.

use burn::module::Param;
use burn::nn::{LayerNorm, LayerNormConfig, Linear, RmsNorm, RmsNormConfig};
use burn::tensor::{Device, Tensor, TensorData};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::network::config::ModelConfig;

/// A source of initialized layers on a device. All layers share one stream of random numbers.
#[derive(Debug)]
pub struct Init {
    device: Device,
    rng: ChaCha8Rng,
    /// Standard deviation of LVSM's matrices, whose layers have no bias; `None` for PyTorch's distributions.
    deviation: Option<f64>,
}

/// Standard deviation of LVSM's matrices outside the blocks, and of its latents.
const DEVIATION: f64 = 0.02;

impl Init {
    /// Starts the stream of `seed` for layers with biases.
    pub fn new(seed: u64, device: &Device) -> Self {
        Self { device: device.clone(), rng: ChaCha8Rng::seed_from_u64(seed), deviation: None }
    }

    /// Starts the stream of `seed` for the layers of a network.
    pub fn of(config: &ModelConfig, seed: u64, device: &Device) -> Self {
        Self { deviation: (!config.has_biases()).then_some(DEVIATION), ..Self::new(seed, device) }
    }

    /// Starts a transformer block by its index, or the layers outside the blocks: LVSM's matrices get smaller with depth.
    pub(crate) fn block(&mut self, index: Option<usize>) -> &mut Self {
        let factor = index.map_or(1.0, |index| (2.0 * (index + 1) as f64).sqrt());
        self.deviation = self.deviation.map(|_| DEVIATION / factor);
        self
    }

    /// Makes learned tokens, `[1, count, dim]`: normal with deviation 0.02, cut at two deviations.
    pub(crate) fn latents(&mut self, count: usize, dim: usize) -> Param<Tensor<3>> {
        let mut sample = || {
            let cut = std::iter::repeat_with(|| self.normal()).find(|value| value.abs() <= 2.0);
            (DEVIATION * cut.expect("without end")) as f32
        };
        let values: Vec<f32> = (0..count * dim).map(|_| sample()).collect();
        Param::from_tensor(Tensor::from_data(TensorData::new(values, [1, count, dim]), &self.device))
    }

    /// Makes a linear layer with bias, both uniform in `+-1/sqrt(inputs)`.
    pub fn linear(&mut self, inputs: usize, outputs: usize) -> Linear {
        let bound = 1.0 / (inputs as f64).sqrt();
        let mut layer = self.matrix(inputs, outputs, bound);
        layer.bias = layer.bias.map(|_| self.uniform([outputs], bound));
        layer
    }

    /// Makes a packed attention projection of `parts` matrices `[dim, dim]`: Xavier-uniform for the whole `[dim, 3 dim]`
    /// matrix of queries, keys and values, with zero bias.
    pub fn attention_in(&mut self, dim: usize, parts: usize) -> Linear {
        self.matrix(dim, parts * dim, (6.0 / (4 * dim) as f64).sqrt())
    }

    /// Makes the projection after attention: uniform weight, zero bias.
    pub fn attention_out(&mut self, dim: usize) -> Linear {
        self.matrix(dim, dim, 1.0 / (dim as f64).sqrt())
    }

    /// Makes a linear layer of zeros: `W_z` of equation 4, or the gate of the released condensers, which has a bias.
    pub fn zero_linear(&mut self, dim: usize, has_bias: bool) -> Linear {
        Linear { weight: self.zeros([dim, dim]), bias: has_bias.then(|| self.zeros([dim])) }
    }

    pub fn rms_norm(&mut self, dim: usize) -> RmsNorm {
        RmsNormConfig::new(dim).init(&self.device)
    }

    pub fn layer_norm(&mut self, dim: usize) -> LayerNorm {
        LayerNormConfig::new(dim).with_bias(self.deviation.is_none()).init(&self.device)
    }

    /// Makes a linear layer, uniform in `+-bound` with zero bias, or normal without bias.
    fn matrix(&mut self, inputs: usize, outputs: usize, bound: f64) -> Linear {
        let Some(deviation) = self.deviation else {
            return Linear { weight: self.uniform([inputs, outputs], bound), bias: Some(self.zeros([outputs])) };
        };
        let values: Vec<f32> = (0..inputs * outputs).map(|_| (deviation * self.normal()) as f32).collect();
        let weight = Tensor::from_data(TensorData::new(values, [inputs, outputs]), &self.device);
        Linear { weight: Param::from_tensor(weight), bias: None }
    }

    /// Samples the normal distribution (Box and Muller).
    fn normal(&mut self) -> f64 {
        let [radius, angle] = [(); 2].map(|()| self.rng.random::<f64>());
        (-2.0 * (1.0 - radius).ln()).sqrt() * (std::f64::consts::TAU * angle).cos()
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
    use crate::testing::{devices, small_lvsm, to_vec};

    #[test]
    fn weights_depend_on_the_seed_and_not_on_the_device() {
        let weights = |seed, device: &Device| to_vec(Init::new(seed, device).linear(16, 8).weight.val());
        let all: Vec<_> = devices().iter().map(|device| weights(7, device)).collect();
        assert!(all.windows(2).all(|pair| pair[0] == pair[1]));
        assert_ne!(all[0], weights(8, &devices()[0]));
    }

    #[test]
    fn weights_of_lvsm_are_normal_and_shrink_with_depth() {
        let deviation = |values: Vec<f64>| (values.iter().map(|x| x * x).sum::<f64>() / values.len() as f64).sqrt();
        let mut init = Init::of(&small_lvsm(), 0, &Device::flex());
        let mut of_block = |index| init.block(index).linear(100, 400);
        assert!(of_block(None).bias.is_none());
        for (index, expected) in [(None, 0.02), (Some(0), 0.02 / 2.0_f64.sqrt()), (Some(7), 0.005)] {
            let got = deviation(to_vec(of_block(index).weight.val()));
            assert!((got / expected - 1.0).abs() < 0.02, "{index:?}: {got}");
        }
        let latents = to_vec(init.latents(100, 400).val());
        assert!(latents.iter().all(|value| value.abs() <= 0.04));
        // A normal distribution cut at two deviations has 0.88 of its deviation.
        assert!((deviation(latents) / (0.88 * 0.02) - 1.0).abs() < 0.02);
    }
}
