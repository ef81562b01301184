//! The training loss (paper section 3.3): mean squared error, and a weighted perceptual term beside it.

use std::fmt;
use std::sync::Arc;

use burn::tensor::{Device, Tensor};
use clift_eval::Perceptual;

use crate::config::config::LossConfig;
use crate::error::TrainError;

/// A term of the training loss.
pub trait ImageLoss: fmt::Debug + Send + Sync {
    /// Computes the term, `[1]`, of renderings.
    ///
    /// # Shapes
    /// - `rendering`, `target`: `[batch, views, height, width, 3]` in `[0, 1]`
    fn loss(&self, rendering: &Tensor<5>, target: &Tensor<5>) -> Tensor<1>;

    /// A line about the term for the log of a run.
    fn describe(&self) -> Option<String> {
        None
    }
}

/// Mean squared error over all values of all images.
#[derive(Clone, Copy, Debug)]
pub struct MeanSquared;

impl ImageLoss for MeanSquared {
    fn loss(&self, rendering: &Tensor<5>, target: &Tensor<5>) -> Tensor<1> {
        mse(rendering.clone(), target.clone())
    }
}

impl ImageLoss for Perceptual {
    fn loss(&self, rendering: &Tensor<5>, target: &Tensor<5>) -> Tensor<1> {
        self.forward(rendering.clone(), target.clone())
    }

    fn describe(&self) -> Option<String> {
        Some(format!("perceptual loss: weights with SHA-256 {}", self.sha256()))
    }
}

/// What a step minimises, the same in both stages: the mean squared error and weighted terms. The default has no
/// further term.
#[derive(Clone, Debug, Default)]
pub struct Loss {
    terms: Vec<(f64, Arc<dyn ImageLoss>)>,
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
        let mut loss = Self::default();
        if let Some(path) = config.weights()? {
            // Constants of the loss: without autodiff.
            let network = Perceptual::load(path, &device.clone().without_autodiff())?;
            loss.terms.push((config.perceptual_weight, Arc::new(network)));
        }
        Ok(loss)
    }

    /// Lines about the terms for the log of a run.
    pub fn describe(&self) -> impl Iterator<Item = String> {
        self.terms.iter().filter_map(|(_, term)| term.describe())
    }

    /// The loss of renderings.
    ///
    /// # Shapes
    /// - `rendering`, `target`: `[batch, views, height, width, 3]` in `[0, 1]`
    pub fn of(&self, rendering: Tensor<5>, target: Tensor<5>) -> LossParts {
        let mse = MeanSquared.loss(&rendering, &target);
        let weighted = self.terms.iter().map(|(weight, term)| term.loss(&rendering, &target).mul_scalar(*weight));
        LossParts { total: weighted.fold(mse.clone(), |total, term| total + term), mse }
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
