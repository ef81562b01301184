//! Renders the context views themselves: contexts too far apart for a model come out as fog.

use clift_data::Clip;
use clift_model::{Clusters, ModelError, SceneClusters, Views, psnr};
use clift_scene::{CheckedView, mean_image, view_image};

use crate::error::EvalError;
use crate::statistics::eval_results::ContextCheck;
use crate::sweep::eval_models::EvalModels;

/// Renders every context view from all tokens, by the model of the last stage.
pub(crate) fn check_contexts(models: &EvalModels, context: &Views, clip: &Clip) -> Result<ContextCheck, EvalError> {
    let model = models.stage2.as_ref().or(models.stage2_tiles.as_ref()).unwrap_or(&models.stage1);
    let mut tokens = model.network.encode(context); // [1, N, D]
    if model.has_condenser {
        let alone = Clusters::new(vec![SceneClusters::identity(tokens.dims()[1])])?;
        tokens = model.network.compress(tokens, &alone.upload(&model.device));
    }
    let images = model.network.render(tokens, &context.cameras); // [1, V, H, W, 3]
    let pixels: Vec<f32> = images.into_data().convert::<f32>().try_to_vec().map_err(ModelError::device)?;
    let mean = mean_image(&clip.context)?;
    let mut check = ContextCheck { num_views: clip.context.num_views(), num_fog: 0 };
    for (view, (pixels, &frame)) in pixels.chunks_exact(mean.len()).zip(&clip.context.frame_index).enumerate() {
        let truth = view_image(&clip.context, view);
        let (psnr, baseline_psnr) = (psnr(pixels, &truth)?, psnr(&mean, &truth)?);
        check.num_fog += usize::from(CheckedView { frame, psnr, baseline_psnr }.is_fog());
    }
    Ok(check)
}
