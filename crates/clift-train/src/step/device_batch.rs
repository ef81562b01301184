//! A batch on a device, and its loss.
// B scenes, T target views, N tokens, D width

use burn::tensor::{Device, Tensor};
use clift_data::Clip;
use clift_model::{Cameras, Clift, Pass, TokenStep, Views, upload_images};

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
}

impl DeviceBatch {
    /// Copies the views of clips to a device.
    ///
    /// # Errors
    /// Those of [`Views::upload`] for views of different sizes.
    pub fn upload(clips: &[Clip], device: &Device) -> Result<Self, TrainError> {
        let contexts: Vec<_> = clips.iter().map(|clip| &clip.context).collect();
        let targets: Vec<_> = clips.iter().map(|clip| &clip.target).collect();
        Ok(Self {
            context: Views::upload(&contexts, device)?,
            targets: Cameras::upload(&targets, device)?,
            target_images: upload_images(&targets, device)?,
        })
    }
}

impl DeviceBatch {
    /// Returns the same views without autodiff.
    pub(crate) fn untracked(&self) -> Self {
        let cameras = |cameras: &Cameras| Cameras {
            c2w: cameras.c2w.clone().inner(),
            intrinsics: cameras.intrinsics.clone().inner(),
            ..*cameras
        };
        let context = Views { images: self.context.images.clone().inner(), cameras: cameras(&self.context.cameras) };
        let (targets, target_images) = (cameras(&self.targets), self.target_images.clone().inner());
        Self { context, targets, target_images }
    }

    /// Describes the forward pass of a model from the context views to images of the target views.
    pub(crate) fn pass<'a>(&'a self, model: &'a Clift, token_step: TokenStep<'a, TrainError>) -> Pass<'a, TrainError> {
        Pass::new(model, &self.context, &self.targets, token_step)
    }
}

/// Renders the target views from selected tokens and returns the loss of an update, with autodiff.
///
/// # Errors
/// Those of clusters that do not fit the tokens.
pub fn render_loss(
    model: &Clift,
    device_batch: &DeviceBatch,
    batch_tokens: &BatchTokens,
    loss: &Loss,
    step: u64,
) -> Result<LossParts, TrainError> {
    let token_step = batch_tokens.step();
    let pass = device_batch.pass(model, &token_step);
    Ok(loss.of(&Rendering::of(&pass, pass.forward()?, step), device_batch.target_images.clone()))
}
