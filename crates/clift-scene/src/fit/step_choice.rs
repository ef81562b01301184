//! The step of a scene's coefficients: the largest of a loss, measured on renderings of the scene, or the smallest of a size.

use clift_core::ClipViews;
use clift_data::ClipReader;
use clift_model::{ModelError, TrainedModel};

use crate::check::baselines::view_image;
use crate::check::view_check::{read_others, render_views, scene_renderer};
use crate::codec::token_codec::TokenCodec;
use crate::error::SceneError;
use crate::fit::fit::{loss, view_errors};
use crate::scene::scene::Scene;

/// Most frames that a loss is measured on.
const MAX_FRAMES: usize = 3;
/// Halvings of a range of losses: steps are found to 2 %.
const LOSS_SEARCH: usize = 9;
/// Largest factor between the step of the model and that of a scene.
const MAX_FACTOR: f64 = 16.0;
/// Halvings of the whole range of steps, for a size.
const SIZE_SEARCH: usize = 32;

/// Finds the largest step at which renderings of a scene lose at most `loss_db`. `scene` has tokens that are not rounded, and was
/// encoded by `model` from scene `index` of `reader`; its loss is measured on frames that are not context views, or on the
/// `context` views where there is no other frame. Returns the step and its loss in dB.
///
/// # Errors
/// The errors of reading the frames, and of the model.
pub fn step_for_loss(
    model: &TrainedModel,
    reader: &ClipReader,
    index: usize,
    (scene, context): (&Scene, &ClipViews),
    codec: &TokenCodec,
    loss_db: f64,
) -> Result<(f32, f64), SceneError> {
    let others = read_others(reader, index, scene, MAX_FRAMES)?;
    let views = others.as_ref().unwrap_or(context);
    let truth: Vec<f32> = (0..views.num_views()).flat_map(|view| view_image(views, view)).collect();
    let rendered =
        |scene: &Scene| Ok::<_, SceneError>(render_views(&mut scene_renderer(model, scene)?, views)?.concat());
    let exact = rendered(scene)?;
    let errors = view_errors(&exact, &truth, truth.len() / views.num_views());
    let measured = |step: f32| -> Result<f64, SceneError> {
        let rounded = Scene { tokens: scene.rounded_tokens(codec, step)?, ..scene.clone() };
        Ok(loss(&exact, &rendered(&rounded)?, &errors))
    };
    let expected = codec.rates.step_for_loss(share(scene)?, loss_db);
    let (mut low, mut high) = (expected / MAX_FACTOR, expected * MAX_FACTOR);
    for _ in 0..LOSS_SEARCH {
        let middle = (low * high).sqrt();
        if measured(middle as f32)? <= loss_db {
            low = middle;
        } else {
            high = middle;
        }
    }
    Ok((low as f32, measured(low as f32)?))
}

/// Finds the smallest step whose scene file has at most `bytes`, and returns the step and the bytes of the file.
///
/// # Errors
/// [`ModelError::BadConfig`] with the least size if no step is large enough.
pub fn step_for_bytes(scene: &Scene, codec: &TokenCodec, bytes: u64) -> Result<(f32, Vec<u8>), SceneError> {
    let [mut low, mut high] = codec.rates.step_range();
    let coded = |step: f64| scene.coded_bytes(codec, step as f32);
    let mut best = coded(high)?;
    if best.len() as u64 > bytes {
        let kb = |bytes: u64| format!("{:.3}", bytes as f64 / 1e3);
        let fix = format!(
            "the least size of {} tokens of this scene is {} kB; store fewer tokens, or ask for more",
            scene.num_tokens(),
            kb(best.len() as u64)
        );
        return Err(ModelError::BadConfig { key: "--size-kb", value: kb(bytes), fix }.into());
    }
    for _ in 0..SIZE_SEARCH {
        let middle = (low * high).sqrt();
        match coded(middle) {
            Ok(file) if file.len() as u64 <= bytes => (high, best) = (middle, file),
            // A step too small for the tokens takes more bytes than any other.
            Ok(_) | Err(ModelError::BadConfig { .. }) => low = middle,
            Err(error) => return Err(error.into()),
        }
    }
    Ok((high as f32, best))
}

/// Returns the expected step of a scene for a loss.
///
/// # Errors
/// [`ModelError::NotDivisible`] for sizes that are not patches.
pub fn expected_step(scene: &Scene, codec: &TokenCodec, loss_db: f64) -> Result<f32, SceneError> {
    Ok(codec.rates.step_for_loss(share(scene)?, loss_db) as f32)
}

/// Returns the stored share of all tokens.
fn share(scene: &Scene) -> Result<f64, SceneError> {
    let all = scene.model.num_tokens(scene.num_members(), scene.height, scene.width)?;
    Ok(scene.num_tokens() as f64 / all as f64)
}
