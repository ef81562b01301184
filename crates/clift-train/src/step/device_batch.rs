//! A batch on a device, and its loss.
// B scenes, T target views, N tokens, D width

use burn::tensor::{Device, Tensor};
use clift_eval::{upload_cameras, upload_images, upload_views};
use clift_model::{Cameras, Clift, SceneModel, Views};

use crate::error::TrainError;
use crate::step::batch::{StageBatch, TokenSelection};
use crate::step::loss::{Loss, LossParts};

/// What a batch shows, on a device.
pub struct DeviceBatch {
    /// The given views.
    pub context: Views,
    /// Where the targets were taken from.
    pub targets: Cameras,
    /// The targets, `[B, T, H, W, 3]`.
    pub pictures: Tensor<5>,
}

impl DeviceBatch {
    /// Copies the views of a batch to a device.
    pub fn upload(batch: &StageBatch, device: &Device) -> Result<Self, TrainError> {
        let contexts: Vec<_> = batch.clips.iter().map(|clip| &clip.context).collect();
        let targets: Vec<_> = batch.clips.iter().map(|clip| &clip.target).collect();
        Ok(Self {
            context: upload_views(&contexts, device)?,
            targets: upload_cameras(&targets, device)?,
            pictures: upload_images(&targets, device)?,
        })
    }
}

/// Renders the targets and compares, on the tape.
pub fn render_loss(
    model: &Clift,
    shown: &DeviceBatch,
    choice: &TokenSelection,
    loss: &Loss,
) -> Result<LossParts, TrainError> {
    let lift = model.encode(&shown.context); // [B, N, D]
    let tokens = choice.apply(&model.condenser, lift)?;
    let rendering = model.render(tokens, &shown.targets);
    Ok(loss.of(rendering, shown.pictures.clone()))
}
