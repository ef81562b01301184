//! Sizes that the steps of a run can have: all, the typical ones, the largest.

use clift_eval::{LPIPS_MIN_SIZE_PX, Method, Sweep};
use clift_model::{Part, SceneSizes};

use crate::config::config::Config;
use crate::config::sweep::sweep;
use crate::error::TrainError;
use crate::events::Stage;

/// The parts of a run, in their order.
pub const PARTS: [Stage; 4] = [Stage::Stage1, Stage::Clusters, Stage::Stage2, Stage::Eval];

/// Target views that an evaluation renders at once.
pub const VIEWS_PER_PASS: usize = 8;

/// Points along the range of shares of tokens that are averaged over.
const NUM_SHARES: usize = 9;

/// Networks that a stage trains.
pub fn trained_parts(stage: Stage) -> &'static [Part] {
    match stage {
        Stage::Stage1 => &[Part::Encoder, Part::TokenNorm, Part::Renderer],
        Stage::Stage2 => &[Part::Condenser, Part::TokenNorm, Part::Renderer],
        Stage::Clusters | Stage::Eval => &[],
    }
}

/// Sizes in the middle of what a stage draws.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TypicalStep {
    /// Context views.
    pub num_context: usize,
    /// Scenes worked off at once, at most.
    pub num_scenes: usize,
    /// One of them.
    pub scene: SceneSizes,
}

/// Scenes of a batch, and of one of its parts at most.
pub fn batch_sizes(config: &Config, stage: Stage) -> (usize, usize) {
    let (batch_size, accumulate) = match stage {
        Stage::Stage2 => (config.stage2.batch_size, config.stage2.accumulate),
        _ => (config.stage1.batch_size, config.stage1.accumulate),
    };
    (batch_size, batch_size.div_ceil(accumulate))
}

/// Sets in how many parts a stage works off its batch.
pub fn set_accumulate(config: &mut Config, stage: Stage, parts: usize) {
    match stage {
        Stage::Stage2 => config.stage2.accumulate = parts,
        _ => config.stage1.accumulate = parts,
    }
}

/// Every size that a scene of a stage can have, equally likely; the shares of stage 1 at a few points.
pub fn possible_sizes(config: &Config, stage: Stage) -> Result<Vec<SceneSizes>, TrainError> {
    let views = &config.data.views;
    let mut all = Vec::new();
    for num_context in views.min_context..=views.max_context {
        let scene = training_scene(config, num_context)?;
        if stage == Stage::Stage2 {
            all.extend(cluster_counts(config, scene.num_tokens)?.into_iter().map(|count| stored(scene, count)));
            continue;
        }
        let [low, high] = config.stage1.keep_tokens;
        let share = |point: usize| low + (high - low) * (point as f64 + 0.5) / NUM_SHARES as f64;
        all.extend((0..NUM_SHARES).map(|point| kept(scene, share(point))));
    }
    Ok(all)
}

/// The sizes that calibration takes: the middle count of contexts and the middle share or count of tokens.
pub fn typical_sizes(config: &Config, stage: Stage) -> Result<TypicalStep, TrainError> {
    let views = &config.data.views;
    let num_context = usize::midpoint(views.min_context, views.max_context);
    let scene = training_scene(config, num_context)?;
    let scene = if stage == Stage::Stage2 {
        let counts = cluster_counts(config, scene.num_tokens)?;
        stored(scene, counts[counts.len() / 2])
    } else {
        let [low, high] = config.stage1.keep_tokens;
        kept(scene, f64::midpoint(low, high))
    };
    Ok(TypicalStep { num_context, num_scenes: batch_sizes(config, stage).1, scene })
}

/// The largest scene of a stage.
pub fn largest_sizes(config: &Config, stage: Stage) -> Result<SceneSizes, TrainError> {
    let scene = training_scene(config, config.data.views.max_context)?;
    if stage == Stage::Stage2 {
        let most = cluster_counts(config, scene.num_tokens)?.last().copied();
        return Ok(stored(scene, most.unwrap_or(scene.num_tokens)));
    }
    let [low, high] = config.stage1.keep_tokens;
    let scene = kept(scene, high);
    // Shares are drawn: with all tokens views share them, with all but one every view has its own.
    let all_but_one = (scene.num_tokens - 1).max(1);
    let is_per_view = low < 1.0;
    let count = if is_per_view { scene.num_render_tokens.min(all_but_one) } else { scene.num_render_tokens };
    Ok(SceneSizes { num_render_tokens: count, is_per_view, ..scene })
}

/// What an evaluation does with a scene: the variants asked for, or all that a run has weights for by itself.
pub fn eval_sizes(config: &Config) -> Sweep {
    let own = [Method::Random, Method::Kmeans, Method::Clift];
    let mut variants = config.eval.variants.clone();
    // A condenser of tiles is another run's.
    variants.retain(|variant| *variant != Method::PatchClift);
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

/// Numbers of clusters that stage 2 draws from, rising.
pub fn cluster_counts(config: &Config, num_tokens: usize) -> Result<Vec<usize>, TrainError> {
    let counts = config.clusters.grid.iter().map(|count| count.of(num_tokens));
    let mut counts = counts.collect::<Result<Vec<_>, _>>()?;
    counts.sort_unstable();
    Ok(counts)
}

/// Values of all images of a training scene.
pub fn image_values(config: &Config) -> usize {
    let views = &config.data.views;
    (views.max_context + views.num_targets) * config.data.height * config.data.width * 3
}

/// A scene whose target views are rendered from all its tokens.
pub fn scene(config: &Config, num_context: usize, num_targets: usize) -> Result<SceneSizes, TrainError> {
    Ok(SceneSizes::new(num_tokens(config, num_context)?, num_targets, num_tokens(config, 1)?))
}

/// A scene whose target views are rendered from `count` stored tokens.
pub fn stored(scene: SceneSizes, count: usize) -> SceneSizes {
    SceneSizes { num_storage_tokens: Some(count), num_render_tokens: count, ..scene }
}

fn training_scene(config: &Config, num_context: usize) -> Result<SceneSizes, TrainError> {
    scene(config, num_context, config.data.views.num_targets)
}

fn kept(scene: SceneSizes, share: f64) -> SceneSizes {
    let count = ((scene.num_tokens as f64 * share) as usize).max(1);
    SceneSizes { num_render_tokens: count, is_per_view: count < scene.num_tokens, ..scene }
}
