//! A batch on a device, and its loss.
// B scenes, T target views, N tokens, D width

use burn::tensor::{Device, Tensor, TensorData};
use clift_core::ClipViews;
use clift_data::Clip;
use clift_model::{Cameras, Network, Views, upload_images};

use crate::error::TrainError;
use crate::step::batch::BatchTokens;
use crate::step::loss::{Loss, LossParts, Rendering};

/// The views of a batch on a device.
pub struct DeviceBatch {
    /// Context views.
    pub context: Views,
    /// Cameras of the target views.
    pub targets: Cameras,
    /// Images of the target views, `[B, T, H, W, 3]` in `[0, 1]`.
    pub target_images: Tensor<5>,
    /// Weights of the target pixels in the loss; `None` where every pixel counts.
    pub target_weights: Option<TargetWeights>,
}

/// Weights of the target pixels in the loss, see [`Clip::target_weights`].
#[derive(Clone, Debug)]
pub struct TargetWeights {
    /// `[B, T, H, W, 1]` in `[0, 1]`.
    values: Tensor<5>,
    mean: f64,
}

impl TargetWeights {
    /// Copies the weights of clips to a device; `None` if all pixels count, or none.
    fn upload(clips: &[Clip], device: &Device) -> Option<Self> {
        let ClipViews { height, width, .. } = clips.iter().find(|clip| clip.target_weights.is_some())?.target;
        let num_targets = clips[0].target.num_views();
        let one = vec![u8::MAX; num_targets * height * width];
        let planes = clips.iter().flat_map(|clip| clip.target_weights.as_ref().unwrap_or(&one));
        let values: Vec<f32> = planes.map(|weight| f32::from(*weight) / 255.0).collect();
        let mean = values.iter().map(|weight| f64::from(*weight)).sum::<f64>() / values.len() as f64;
        let data = TensorData::new(values, [clips.len(), num_targets, height, width, 1]);
        (mean > 0.0).then(|| Self { values: Tensor::from_data(data, device), mean })
    }
}

impl DeviceBatch {
    /// Copies the views of clips to a device.
    pub fn upload(clips: &[Clip], device: &Device) -> Result<Self, TrainError> {
        let contexts: Vec<_> = clips.iter().map(|clip| &clip.context).collect();
        let targets: Vec<_> = clips.iter().map(|clip| &clip.target).collect();
        Ok(Self {
            context: Views::upload(&contexts, device)?,
            targets: Cameras::upload(&targets, device)?,
            target_images: upload_images(&targets, device)?,
            target_weights: TargetWeights::upload(clips, device),
        })
    }

    /// Returns the loss of a rendering. Masked pixels are replaced by the target's, so that they add nothing.
    fn loss(&self, loss: &Loss, rendering: Rendering) -> LossParts {
        let target = self.target_images.clone();
        let Some(TargetWeights { values, mean }) = &self.target_weights else {
            return loss.of(&rendering, target, 1.0);
        };
        let images = target.clone() + (rendering.images - target.clone()) * values.clone();
        loss.of(&Rendering { images, ..rendering }, target, *mean)
    }
}

/// Renders the target views from selected tokens and returns the loss of an update, with autodiff.
pub fn render_loss(
    model: &Network,
    device_batch: &DeviceBatch,
    batch_tokens: &BatchTokens,
    loss: &Loss,
    step: u64,
) -> Result<LossParts, TrainError> {
    let tokens = batch_tokens.select(model, model.encode(&device_batch.context))?;
    let values = tokens.values().clone();
    let images = model.renderer.forward(tokens, &device_batch.targets);
    Ok(device_batch.loss(loss, Rendering { images, tokens: values, step }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::step::seeded_inputs::{ClipShape, seeded_clip};

    #[test]
    fn masked_pixels_add_nothing_to_the_loss() {
        let device = Device::flex();
        let clip = seeded_clip(ClipShape { num_context: 2, num_targets: 2, size: [8, 8] }, 1, 0);
        // Errors of 0.1 in the first view and of 0.5 in the second, whose pixels do not count.
        let weights = [[255; 64], [0; 64]].concat();
        let errors = [vec![0.1_f32; 192], vec![0.5; 192]].concat();
        for (target_weights, expected) in [(Some(weights), 0.01), (Some(vec![0; 128]), 0.13), (None, 0.13)] {
            let batch = DeviceBatch::upload(&[Clip { target_weights, ..clip.clone() }], &device).expect("one clip");
            let errors = Tensor::from_data(TensorData::new(errors.clone(), [1, 2, 8, 8, 3]), &device);
            let images = batch.target_images.clone() + errors;
            let rendering = Rendering { images, tokens: Tensor::zeros([1, 1, 1], &device), step: 0 };
            let mse: f32 = batch.loss(&Loss::default(), rendering).mse.into_scalar();
            assert!((mse - expected).abs() < 1e-6, "{mse} is not {expected}");
        }
    }
}
