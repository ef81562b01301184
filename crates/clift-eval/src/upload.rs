//! Clips of `clift-data` as tensors of `clift-model`, and tokens back on the host.

use burn::tensor::{Device, Tensor};
use clift_data::ClipViews;
use clift_model::{Cameras, Tokens, ViewCamera, Views};

use crate::error::EvalError;

/// Uploads images and cameras, one set of views per scene.
///
/// # Shapes
/// - `scenes`: sets of the same number of views of the same size
/// - returns `[batch, views, ..]`
///
/// # Errors
/// [`EvalError::Model`] when the sets differ in number or size, or a camera is not finite.
pub fn upload_views(scenes: &[&ClipViews], device: &Device) -> Result<Views, EvalError> {
    let (c2w, intrinsics) = camera_values(scenes);
    Ok(Views::upload(&pixel_values(scenes), &c2w, &intrinsics, shape(scenes), device)?)
}

/// Returns the values of tokens, `[1, S, D]`, on the host.
pub(crate) fn host_values(tokens: &Tokens) -> Result<Vec<f32>, EvalError> {
    tokens.values.clone().into_data().convert::<f32>().try_to_vec().map_err(EvalError::tensor)
}

/// Uploads only the images, RGB in `[0, 1]`, `[batch, views, height, width, 3]`. See [`upload_views`].
pub fn upload_images(scenes: &[&ClipViews], device: &Device) -> Result<Tensor<5>, EvalError> {
    Ok(clift_model::upload_images(&pixel_values(scenes), shape(scenes), device)?)
}

/// Uploads only the cameras. See [`upload_views`].
pub fn upload_cameras(scenes: &[&ClipViews], device: &Device) -> Result<Cameras, EvalError> {
    let (c2w, intrinsics) = camera_values(scenes);
    Ok(Cameras::upload(&c2w, &intrinsics, shape(scenes), device)?)
}

/// Returns the cameras of one scene on the host, the input of token selection.
pub fn view_cameras(views: &ClipViews) -> Vec<ViewCamera> {
    let cameras = views.c2w.iter().zip(&views.intrinsics);
    cameras.map(|(pose, k)| ViewCamera { c2w: pose.to_matrix_f64(), intrinsics: [k.fx, k.fy, k.cx, k.cy] }).collect()
}

fn pixel_values(scenes: &[&ClipViews]) -> Vec<u8> {
    scenes.iter().map(|views| &views.images[..]).collect::<Vec<_>>().concat()
}

fn camera_values(scenes: &[&ClipViews]) -> (Vec<f32>, Vec<f32>) {
    let c2w = scenes.iter().flat_map(|views| &views.c2w).flat_map(|pose| pose.to_matrix()).collect();
    let intrinsics = scenes.iter().flat_map(|views| &views.intrinsics);
    let intrinsics = intrinsics.flat_map(|k| [k.fx, k.fy, k.cx, k.cy].map(|value| value as f32)).collect();
    (c2w, intrinsics)
}

/// Returns `[batch, views, height, width]` from the first scene; the uploads check the other scenes.
fn shape(scenes: &[&ClipViews]) -> [usize; 4] {
    scenes.first().map_or([0; 4], |first| [scenes.len(), first.num_views(), first.height, first.width])
}
