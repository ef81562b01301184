//! Sizes of the steps of a run: all possible ones, the largest.

use clift_eval::{EvalConfig, Method};
use clift_model::{LPIPS_MIN_SIZE_PX, SceneSizes};

use crate::config::config::Config;
use crate::error::TrainError;
use crate::events::Stage;

/// Target views that an evaluation renders at once.
pub const VIEWS_PER_PASS: usize = 8;
/// Number of token shares over which averages are taken.
const NUM_SHARES: usize = 9;

/// Returns every size that a scene of a stage can have, equally likely; in stage 1 for a few shares of tokens.
pub fn possible_sizes(config: &Config, stage: Stage) -> Result<Vec<SceneSizes>, TrainError> {
    let views = &config.data.views;
    let mut all = Vec::new();
    for num_context in views.min_context..=views.max_context {
        let scene = training_scene(config, num_context)?;
        if stage == Stage::Stage2 {
            let counts = cluster_counts(config, scene.num_tokens)?;
            all.extend(counts.into_iter().map(|count| scene_with_stored_tokens(scene, count)));
            continue;
        }
        let [low, high] = config.stage1.keep_tokens;
        let share = |point: usize| low + (high - low) * (point as f64 + 0.5) / NUM_SHARES as f64;
        all.extend((0..NUM_SHARES).map(|point| kept(scene, share(point))));
    }
    Ok(all)
}

pub fn largest_sizes(config: &Config, stage: Stage) -> Result<SceneSizes, TrainError> {
    let scene = training_scene(config, config.data.views.max_context)?;
    if stage == Stage::Stage2 {
        let most = cluster_counts(config, scene.num_tokens)?.last().copied();
        return Ok(scene_with_stored_tokens(scene, most.unwrap_or(scene.num_tokens)));
    }
    let [low, high] = config.stage1.keep_tokens;
    let scene = kept(scene, high);
    // Views share the tokens only if all are kept; with one token less, every view has its own subset.
    let all_but_one = (scene.num_tokens - 1).max(1);
    let is_per_view = low < 1.0;
    let count = if is_per_view { scene.num_render_tokens.min(all_but_one) } else { scene.num_render_tokens };
    Ok(SceneSizes { num_render_tokens: count, is_per_view, ..scene })
}

/// Returns the settings of an evaluation with the methods that a run has weights for, of those of the config.
pub fn planned_eval(config: &Config) -> EvalConfig {
    let architecture = config.model.architecture;
    let condensed = Method::condensed(config.clusters.grouping);
    let mut methods = config.eval.methods.clone();
    // The condenser of another grouping belongs to another run.
    methods.retain(|method| !method.is_condensed() || *method == condensed);
    if !architecture.supports_clusters() {
        methods = vec![Method::Whole(architecture)];
    } else if methods.is_empty() {
        methods = vec![Method::Random, Method::Kmeans, condensed];
    }
    EvalConfig { methods, ..config.eval.clone() }
}

/// Whether an evaluation measures LPIPS.
pub fn measures_lpips(config: &Config) -> bool {
    config.eval.lpips_path().is_some() && config.data.width.min(config.data.height) >= LPIPS_MIN_SIZE_PX
}

/// Returns the number of encoder tokens of a scene.
pub fn num_tokens(config: &Config, num_context: usize) -> Result<usize, TrainError> {
    Ok(config.model.num_tokens(num_context, config.data.height, config.data.width)?)
}

/// Returns the number of patches of some views.
pub fn num_patches(config: &Config, num_views: usize) -> Result<usize, TrainError> {
    Ok(config.model.num_patches(num_views, config.data.height, config.data.width)?)
}

/// Returns the numbers of clusters that stage 2 samples from, ascending.
pub fn cluster_counts(config: &Config, num_tokens: usize) -> Result<Vec<usize>, TrainError> {
    let counts = config.clusters.grid.iter().map(|count| count.of(num_tokens));
    let mut counts = counts.collect::<Result<Vec<_>, _>>()?;
    counts.sort_unstable();
    Ok(counts)
}

/// Returns the number of values of all images of the largest training scene.
pub fn image_values(config: &Config) -> usize {
    let views = &config.data.views;
    (views.max_context + views.num_targets) * config.data.height * config.data.width * 3
}

/// Returns the sizes of a scene whose target views are rendered from all its tokens.
pub fn scene_with_all_tokens(
    config: &Config,
    num_context: usize,
    num_targets: usize,
) -> Result<SceneSizes, TrainError> {
    let size = [config.data.height, config.data.width];
    Ok(SceneSizes::of(&config.model, num_context, num_targets, size)?)
}

/// Returns the sizes of a scene whose target views are rendered from `count` stored tokens.
pub fn scene_with_stored_tokens(scene: SceneSizes, count: usize) -> SceneSizes {
    SceneSizes { num_storage_tokens: Some(count), num_render_tokens: count, ..scene }
}

fn training_scene(config: &Config, num_context: usize) -> Result<SceneSizes, TrainError> {
    scene_with_all_tokens(config, num_context, config.data.views.num_targets)
}

/// Returns the sizes of a scene whose target views are rendered from a share of its tokens.
pub fn kept(scene: SceneSizes, share: f64) -> SceneSizes {
    let count = ((scene.num_tokens as f64 * share) as usize).max(1);
    SceneSizes { num_render_tokens: count, is_per_view: count < scene.num_tokens, ..scene }
}
