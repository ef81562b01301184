//! The sizes that steps of a run have: those in the middle, the average, and the largest.

use clift_eval::lpips::LPIPS_MIN_SIZE_PX;
use clift_eval::{Sweep, Variant};

use super::counts::{Macs, SceneSizes};
use crate::TrainError;
use crate::config::Config;
use crate::events::Stage;
use crate::sweep::sweep;

/// Points along the range of shares of tokens that are averaged over.
const NUM_SHARES: usize = 9;

/// Sizes in the middle of what a stage draws.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Middle {
    /// Context views.
    pub num_context: usize,
    /// Scenes worked off at once, at most.
    pub num_scenes: usize,
    /// One of them.
    pub scene: SceneSizes,
}

/// Multiplications of a scene's share of an update.
pub fn update_macs(config: &Config, stage: Stage, scene: &SceneSizes) -> f64 {
    let macs = Macs::of(&config.model, scene);
    if stage == Stage::Stage2 { macs.stage2_update(config.recompute) } else { macs.stage1_update(config.recompute) }
}

/// Scenes of a batch, and of one of its parts at most.
pub fn batch_sizes(config: &Config, stage: Stage) -> (usize, usize) {
    let (batch_size, accumulate) = match stage {
        Stage::Stage2 => (config.stage2.batch_size, config.stage2.accumulate),
        _ => (config.stage1.batch_size, config.stage1.accumulate),
    };
    (batch_size, batch_size.div_ceil(accumulate))
}

/// Every size that a scene of a stage can have, equally likely; the shares of stage 1 at a few points.
pub fn drawn(config: &Config, stage: Stage) -> Result<Vec<SceneSizes>, TrainError> {
    let views = &config.data.views;
    let mut all = Vec::new();
    for num_context in views.min_context..=views.max_context {
        if stage == Stage::Stage2 {
            let num_tokens = num_tokens(config, num_context)?;
            for count in &config.clusters.grid {
                all.push(stored(config, num_context, count.of(num_tokens)? as f64)?);
            }
            continue;
        }
        let [low, high] = config.stage1.keep_tokens;
        for point in 0..NUM_SHARES {
            let share = low + (high - low) * (point as f64 + 0.5) / NUM_SHARES as f64;
            all.push(kept(config, num_context, share)?);
        }
    }
    Ok(all)
}

/// The sizes that calibration takes: the middle count of contexts and the middle share or count of tokens.
pub fn middle(config: &Config, stage: Stage) -> Result<Middle, TrainError> {
    let views = &config.data.views;
    let num_context = usize::midpoint(views.min_context, views.max_context);
    let scene = if stage == Stage::Stage2 {
        let num_tokens = num_tokens(config, num_context)?;
        let counts = config.clusters.grid.iter().map(|count| count.of(num_tokens));
        let mut counts = counts.collect::<Result<Vec<_>, _>>()?;
        counts.sort_unstable();
        stored(config, num_context, counts[counts.len() / 2] as f64)?
    } else {
        let [low, high] = config.stage1.keep_tokens;
        kept(config, num_context, f64::midpoint(low, high))?
    };
    Ok(Middle { num_context, num_scenes: batch_sizes(config, stage).1, scene })
}

/// The largest scene of a stage.
pub fn largest(config: &Config, stage: Stage) -> Result<SceneSizes, TrainError> {
    let num_context = config.data.views.max_context;
    if stage != Stage::Stage2 {
        let [low, high] = config.stage1.keep_tokens;
        let scene = kept(config, num_context, high)?;
        // Shares are drawn: with all tokens views share them, with all but one every view has its own.
        let all_but_one = (scene.num_tokens - 1.0).max(1.0);
        let is_per_view = low < 1.0;
        let count = if is_per_view { scene.num_render_tokens.min(all_but_one) } else { scene.num_render_tokens };
        return Ok(SceneSizes { num_render_tokens: count, is_per_view, ..scene });
    }
    let num_tokens = num_tokens(config, num_context)?;
    let counts = config.clusters.grid.iter().map(|count| count.of(num_tokens));
    let most = counts.collect::<Result<Vec<_>, _>>()?.into_iter().max().unwrap_or(num_tokens);
    stored(config, num_context, most as f64)
}

/// What an evaluation does with a scene: the variants asked for, or all that a run has weights for by itself.
pub fn evaluated(config: &Config) -> Sweep {
    let own = [Variant::Random, Variant::Kmeans, Variant::Clift];
    let mut variants = config.eval.variants.clone();
    // A condenser of tiles is another run's.
    variants.retain(|variant| *variant != Variant::PatchClift);
    sweep(config, config.eval.storage.clone(), if variants.is_empty() { own.to_vec() } else { variants })
}

/// Whether an evaluation measures LPIPS.
pub fn measures_lpips(config: &Config) -> bool {
    config.eval.lpips_path().is_some() && config.data.width.min(config.data.height) >= LPIPS_MIN_SIZE_PX
}

/// Encoder tokens of a scene.
pub fn num_tokens(config: &Config, num_context: usize) -> Result<usize, TrainError> {
    Ok(config.model.num_tokens(num_context, config.data.height, config.data.width)?)
}

/// Values of all pictures of a training scene.
pub fn picture_values(config: &Config) -> f64 {
    let views = &config.data.views;
    ((views.max_context + views.num_targets) * config.data.height * config.data.width * 3) as f64
}

fn kept(config: &Config, num_context: usize, share: f64) -> Result<SceneSizes, TrainError> {
    let all = num_tokens(config, num_context)? as f64;
    let count = (all * share).floor().max(1.0);
    Ok(SceneSizes {
        num_tokens: all,
        num_storage_tokens: None,
        num_render_tokens: count,
        is_per_view: count < all,
        num_targets: config.data.views.num_targets as f64,
        num_patches: num_tokens(config, 1)? as f64,
    })
}

fn stored(config: &Config, num_context: usize, count: f64) -> Result<SceneSizes, TrainError> {
    let scene = kept(config, num_context, 1.0)?;
    Ok(SceneSizes { num_storage_tokens: Some(count), num_render_tokens: count, ..scene })
}
