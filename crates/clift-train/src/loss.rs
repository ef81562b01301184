//! The training loss (paper section 3.3): mean squared error, and a weighted perceptual term beside it.

use burn::tensor::{Device, Tensor};
use clift_eval::Perceptual;

use crate::TrainError;
use crate::config::LossConfig;

/// What a step minimises, the same in both stages. The default is the mean squared error alone.
#[derive(Clone, Debug, Default)]
pub struct Loss {
    /// Weight and network of the perceptual term.
    perceptual: Option<(f64, Perceptual)>,
}

/// The loss of a batch, on the tape.
#[derive(Clone, Debug)]
pub struct LossParts {
    /// What is minimised, `[1]`.
    pub total: Tensor<1>,
    /// The mean squared error in it, `[1]`: what PSNR is of.
    pub mse: Tensor<1>,
}

impl Loss {
    /// Makes the loss of a config, reading the network's weights where it has a perceptual term.
    ///
    /// # Errors
    /// As [`LossConfig::weights`] and [`Perceptual::load`].
    pub fn load(config: &LossConfig, device: &Device) -> Result<Self, TrainError> {
        let Some(path) = config.weights()? else { return Ok(Self::default()) };
        // Constants of the loss: without autodiff.
        let network = Perceptual::load(path, &device.clone().without_autodiff())?;
        Ok(Self { perceptual: Some((config.perceptual_weight, network)) })
    }

    /// SHA-256 of the weights of the perceptual term, where there is one.
    pub fn sha256(&self) -> Option<&str> {
        self.perceptual.as_ref().map(|(_, network)| network.sha256())
    }

    /// The loss of renderings.
    ///
    /// # Shapes
    /// - `rendering`, `target`: `[batch, views, height, width, 3]` in `[0, 1]`
    pub fn of(&self, rendering: Tensor<5>, target: Tensor<5>) -> LossParts {
        let mse = mse(rendering.clone(), target.clone());
        let total = match &self.perceptual {
            Some((weight, network)) => mse.clone() + network.forward(rendering, target).mul_scalar(*weight),
            None => mse.clone(),
        };
        LossParts { total, mse }
    }
}

/// Mean squared error over all values of all pictures.
///
/// # Shapes
/// - `rendering`, `target`: `[batch, views, height, width, 3]` in `[0, 1]`
/// - returns a scalar, `[1]`
pub fn mse(rendering: Tensor<5>, target: Tensor<5>) -> Tensor<1> {
    (rendering - target).square().mean()
}

/// PSNR in dB of a mean squared error of values in `[0, 1]`.
pub fn psnr_of(mse: f64) -> f64 {
    -10.0 * mse.log10()
}
