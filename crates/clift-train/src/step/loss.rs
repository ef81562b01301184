//! The training loss (paper section 3.3): mean squared error and a perceptual term.

use std::sync::Arc;

use burn::tensor::{Device, Tensor};
use clift_model::Perceptual;

use crate::config::config::LossConfig;
use crate::error::TrainError;

/// Rendered target views of a batch, and their origin: what a term of the loss may depend on.
#[derive(Clone, Debug)]
pub struct Rendering {
    /// RGB in `(0, 1)`, `[batch, views, height, width, 3]`.
    pub images: Tensor<5>,
    /// Tokens that the images are rendered from, `[sets, num_tokens, dim]`: one set per scene, or per target view.
    pub tokens: Tensor<3>,
    /// Update of the stage, counted from 0.
    pub step: u64,
}

/// The minimized loss, the same in both stages: mean squared error, and a weighted perceptual term if the config has one.
#[derive(Clone, Debug, Default)]
pub struct Loss {
    perceptual: Option<(f64, Arc<Perceptual>)>,
}

/// The loss of a batch, with autodiff.
#[derive(Clone, Debug)]
pub struct LossParts {
    /// The minimized loss, `[1]`.
    pub total: Tensor<1>,
    /// The mean squared error, `[1]`, from which PSNR is computed.
    pub mse: Tensor<1>,
}

impl Loss {
    /// Makes the loss of a config; reads the VGG weights if there is a perceptual term.
    pub fn load(config: &LossConfig, device: &Device) -> Result<Self, TrainError> {
        let Some(path) = config.weights()? else { return Ok(Self::default()) };
        let network = Perceptual::load(path, &device.clone().without_autodiff())?;
        Ok(Self { perceptual: Some((config.perceptual_weight, Arc::new(network))) })
    }

    /// Describes the perceptual term for the log of a run.
    pub fn describe(&self) -> Option<String> {
        let (_, network) = self.perceptual.as_ref()?;
        Some(format!("perceptual loss: weights with SHA-256 {}", network.sha256()))
    }

    /// Computes the loss of a rendering.
    ///
    /// # Shapes
    /// - `target`: `[batch, views, height, width, 3]` in `[0, 1]`
    pub fn of(&self, rendering: &Rendering, target: Tensor<5>) -> LossParts {
        let mse = mse(rendering.images.clone(), target.clone());
        let total = match &self.perceptual {
            Some((weight, network)) => {
                mse.clone() + network.forward(rendering.images.clone(), target).mul_scalar(*weight)
            }
            None => mse.clone(),
        };
        LossParts { total, mse }
    }
}

/// Computes the mean squared error over all values of all images.
///
/// # Shapes
/// - `rendering`, `target`: `[batch, views, height, width, 3]` in `[0, 1]`
/// - returns a scalar, `[1]`
pub fn mse(rendering: Tensor<5>, target: Tensor<5>) -> Tensor<1> {
    (rendering - target).square().mean()
}
