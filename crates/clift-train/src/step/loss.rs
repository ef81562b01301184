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

/// Mean squared error above which [`LossConfig::log_mse`] weighs a view less.
const LOG_MSE: f64 = 1e-4;

/// Factor that gives a view of 20 dB about the gradient that the mean squared error gives it.
const LOG_FACTOR: f64 = 1e-2;

/// The minimized loss, the same in both stages: mean squared error or its logarithm, and a weighted perceptual term if the
/// config has one.
#[derive(Clone, Debug, Default)]
pub struct Loss {
    is_log: bool,
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
        let is_log = config.log_mse;
        let Some(path) = config.weights()? else { return Ok(Self { is_log, perceptual: None }) };
        let network = Perceptual::load(path, &device.clone().without_autodiff())?;
        Ok(Self { is_log, perceptual: Some((config.perceptual_weight, Arc::new(network))) })
    }

    /// Describes the perceptual term for the log of a run.
    pub fn describe(&self) -> Option<String> {
        let (_, network) = self.perceptual.as_ref()?;
        Some(format!("perceptual loss: weights with SHA-256 {}", network.sha256()))
    }

    /// Computes the loss of a rendering that equals the target in masked pixels.
    ///
    /// # Shapes
    /// - `target`: `[batch, views, height, width, 3]` in `[0, 1]`
    /// - `share`: share of the pixels that are not masked, in `(0, 1]`
    pub fn of(&self, rendering: &Rendering, target: Tensor<5>, share: f64) -> LossParts {
        let errors = (rendering.images.clone() - target.clone()).square();
        let mse = errors.clone().mean().div_scalar(share);
        let pixels = if self.is_log { mean_logarithm(errors, share) } else { mse.clone() };
        let total = match &self.perceptual {
            Some((weight, network)) => {
                pixels + network.forward(rendering.images.clone(), target).mul_scalar(*weight / share)
            }
            None => pixels,
        };
        LossParts { total, mse }
    }
}

/// Averages `0.01 ln(1 + MSE / 0.0001)` over the views, whose pixels are masked but for a `share`.
///
/// # Shapes
/// - `squared_errors`: `[batch, views, height, width, 3]`, 0 in masked pixels
/// - returns a scalar, `[1]`
fn mean_logarithm(squared_errors: Tensor<5>, share: f64) -> Tensor<1> {
    let [batch, views, height, width, 3] = squared_errors.dims() else { panic!("images have three channels") };
    let mse = squared_errors.reshape([batch * views, height * width * 3]).mean_dim(1);
    mse.div_scalar(share * LOG_MSE).log1p().mean().mul_scalar(LOG_FACTOR)
}

#[cfg(test)]
mod tests {
    use burn::tensor::TensorData;

    use super::*;

    #[test]
    fn the_logarithm_weighs_every_view_by_its_own_error() {
        let device = Device::flex();
        let loss = Loss::load(&LossConfig { log_mse: true, ..LossConfig::default() }, &device).expect("no VGG weights");
        // Two views of 16 pixels with errors of 0.1 and of 0.5.
        let errors = [[0.1_f32; 48], [0.5; 48]].concat();
        let images =
            Tensor::<5>::from_data(TensorData::new(errors, [1, 2, 4, 4, 3]), &device).autodiff().require_grad();
        let rendering = Rendering { images, tokens: Tensor::zeros([1, 1, 1], &device), step: 0 };
        for share in [1.0, 0.25] {
            let LossParts { total, mse } =
                loss.of(&rendering, Tensor::zeros([1, 2, 4, 4, 3], &device).autodiff(), share);
            let grads = rendering.images.grad(&total.clone().backward()).expect("the images are tracked");
            let views = [0.1_f64, 0.5].map(|error| (error, error * error / share));
            let expected = views.map(|(_, mse)| 0.01 * (1.0 + mse / 1e-4).ln()).iter().sum::<f64>() / 2.0;
            // A few roundings in f32.
            let [total, mse] = [total, mse].map(|value| f64::from(value.into_scalar::<f32>()));
            assert!((total - expected).abs() < 1e-7 && (mse - 0.13 / share).abs() < 1e-6, "{total}, {mse}");
            let grads: Vec<f32> = grads.into_data().try_to_vec().expect("f32");
            for ((error, mse), grads) in views.iter().zip(grads.chunks(48)) {
                let expected = 0.01 / (1e-4 + mse) * 2.0 * error / share / 96.0;
                assert!(
                    grads.iter().all(|&grad| (f64::from(grad) / expected - 1.0).abs() < 1e-5),
                    "{expected}, {grads:?}"
                );
            }
        }
    }
}
