//! Floating-point operations of a case.

use clift_data::DataConfig;
use clift_model::{FlopConvention, Macs, ModelConfig, PatchGrids};
use clift_train::TrainError;

use crate::cases::case::BenchCase;
use crate::cases::context::BenchContext;

/// Returns the floating-point operations of layers and attention in one repetition: two per multiply-accumulate, a backward
/// counts as two forwards, what is computed twice counts once. `None` for other cases.
pub fn flops(case: BenchCase, context: &BenchContext) -> Result<Option<f64>, TrainError> {
    let tiny = (case == BenchCase::Stage1StepTiny).then(|| context.tiny());
    let context = tiny.as_ref().unwrap_or(context);
    let config = &context.config;
    let DataConfig { width, height, views, .. } = &config.data;
    let count = |macs: Macs| macs.count(FlopConvention::Flops) as f64;
    let all = context.num_tokens()?;
    let encode = count(config.model.encode_macs(views.min_context, *height, *width)?);
    // The cases draw an image once, as training does.
    let drawn_once = ModelConfig { patch_grids: PatchGrids::One, ..config.model.clone() };
    let render = |tokens| Ok::<_, TrainError>(count(drawn_once.render_macs(*height, *width, tokens)?));
    let condense = |stored| count(config.model.condense_macs(all, stored));
    let targets = views.num_targets as f64;
    Ok(Some(match case {
        BenchCase::Encode => encode,
        BenchCase::Condense => condense(context.num_storage_tokens()?),
        BenchCase::Render => render(context.num_render_tokens()?)?,
        BenchCase::Stage1Step | BenchCase::Stage1StepTiny => {
            config.stage1.batch_size as f64 * 3.0 * (encode + targets * render(all)?)
        }
        BenchCase::Stage2Step => {
            let stored = context.num_storage_tokens()?;
            config.stage2.batch_size as f64 * (encode + 3.0 * (condense(stored) + targets * render(stored)?))
        }
        // Views of a scene share keys and values of the tokens; the others compute no layers.
        BenchCase::Render8Views
        | BenchCase::Kmeans
        | BenchCase::ClusterAttention
        | BenchCase::Select
        | BenchCase::CodeTokens
        | BenchCase::DecodeTokens => return Ok(None),
    }))
}
