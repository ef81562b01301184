//! The training loss (paper section 3.3): mean squared error and weighted terms.

use std::fmt;
use std::sync::Arc;

use burn::tensor::{Device, Tensor};
use clift_model::{Pass, PassState, Perceptual};

use crate::config::config::LossConfig;
use crate::error::TrainError;

/// Rendered target views of a batch, and their origin.
#[derive(Clone, Debug)]
pub struct Rendering {
    /// RGB in `(0, 1)`, `[batch, views, height, width, 3]`.
    pub images: Tensor<5>,
    /// Tokens that the images are rendered from, `[sets, num_tokens, dim]`: one set per scene, or per target view.
    pub tokens: Tensor<3>,
    /// Update of the stage, counted from 0.
    pub step: u64,
}

impl Rendering {
    /// Decodes the values after the last block of a pass.
    pub(crate) fn of<E>(pass: &Pass<'_, E>, last: PassState, step: u64) -> Self {
        let tokens = last.tokens.as_ref().expect("the renderer's tokens").values().clone();
        Self { images: pass.to_image(last), tokens, step }
    }
}

/// A term of the training loss. `examples/custom_loss.rs` trains with a new one.
pub trait LossTerm: fmt::Debug + Send + Sync {
    /// Computes the term, `[1]`, with autodiff.
    ///
    /// # Shapes
    /// - `target`: `[batch, views, height, width, 3]` in `[0, 1]`
    fn loss(&self, rendering: &Rendering, target: &Tensor<5>) -> Tensor<1>;

    /// Describes the term for the log of a run.
    fn describe(&self) -> Option<String> {
        None
    }
}

impl LossTerm for Perceptual {
    fn loss(&self, rendering: &Rendering, target: &Tensor<5>) -> Tensor<1> {
        self.forward(rendering.images.clone(), target.clone())
    }

    fn describe(&self) -> Option<String> {
        Some(format!("perceptual loss: weights with SHA-256 {}", self.sha256()))
    }
}

/// The minimized loss, the same in both stages: mean squared error plus weighted terms. The default has no further term.
#[derive(Clone, Debug, Default)]
pub struct Loss {
    terms: Vec<(f64, Arc<dyn LossTerm>)>,
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
        Ok(Self::default().with_term(config.perceptual_weight, network))
    }

    /// Adds `weight` times a term.
    #[must_use]
    pub fn with_term(mut self, weight: f64, term: impl LossTerm + 'static) -> Self {
        self.terms.push((weight, Arc::new(term)));
        self
    }

    /// Describes the terms for the log of a run.
    pub fn describe(&self) -> impl Iterator<Item = String> {
        self.terms.iter().filter_map(|(_, term)| term.describe())
    }

    /// Computes the loss of a rendering.
    ///
    /// # Shapes
    /// - `target`: `[batch, views, height, width, 3]` in `[0, 1]`
    pub fn of(&self, rendering: &Rendering, target: Tensor<5>) -> LossParts {
        let mse = mse(rendering.images.clone(), target.clone());
        let weighted = self.terms.iter().map(|(weight, term)| term.loss(rendering, &target).mul_scalar(*weight));
        LossParts { total: weighted.fold(mse.clone(), |total, term| total + term), mse }
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
