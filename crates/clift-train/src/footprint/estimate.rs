//! Speed of a run and its remaining time, estimated from its first steps by the multiply-accumulates of the later work.

use clift_data::SourceKind;
use clift_model::{FlopConvention, Part, SceneSizes};

use crate::config::config::Config;
use crate::error::TrainError;
use crate::events::{RunStep, Stage};
use crate::footprint::memory::{planned_eval, scene};

/// Number of token shares over which averages are taken.
const NUM_SHARES: usize = 9;

/// Speed of a run and its remaining time, estimated from a step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RunEstimate {
    /// Floating-point operations per second of a rank.
    pub flops_per_s: f64,
    /// Seconds of the later work at this speed. Parts whose number of scenes depends on the data do not count.
    pub remaining_s: f64,
}

/// Estimates speed and remaining time of a run on `num_ranks` ranks from the wall time `step_s` of `step` of a stage.
pub fn estimate_run(
    config: &Config,
    num_ranks: usize,
    stage: Stage,
    step: u64,
    step_s: f64,
) -> Result<RunEstimate, TrainError> {
    let half = Config { data: config.data.at_half_resolution(), ..config.clone() };
    let half_steps = config.stage(stage).half_resolution_steps;
    let num_half = half_steps.saturating_sub(step) as f64;
    let num_whole = config.stage(stage).steps.saturating_sub(step) as f64 - num_half;
    let later_steps = config.run_steps().iter().skip_while(|run_step| **run_step != stage.into()).skip(1);
    let mut later = num_whole * update_macs(config, stage, num_ranks)?;
    if num_half > 0.0 {
        later += num_half * update_macs(&half, stage, num_ranks)?;
    }
    for run_step in later_steps {
        later += match run_step {
            RunStep::Train(stage) => config.stage(*stage).steps as f64 * update_macs(config, *stage, num_ranks)?,
            RunStep::Clusters => cluster_macs(config)? / num_ranks as f64,
            RunStep::Eval => evaluation_macs(config)?,
        };
    }
    let of_step = update_macs(if step <= half_steps { &half } else { config }, stage, num_ranks)?;
    Ok(RunEstimate { flops_per_s: 2.0 * of_step / step_s, remaining_s: step_s * later / of_step })
}

fn part_macs(config: &Config, network: Part, scene: &SceneSizes) -> f64 {
    config.model.macs(network, scene).count(FlopConvention::Macs) as f64
}

/// Returns the multiply-accumulates of an update of a rank, the mean over all sizes of scenes. A backward pass counts as two
/// forward passes, as for linear layers.
fn update_macs(config: &Config, stage: Stage, num_ranks: usize) -> Result<f64, TrainError> {
    let views = &config.data.views;
    let (mut macs, mut count) = (0.0, 0);
    for num_context in views.min_context..=views.max_context {
        let scene = scene(config, num_context, views.num_targets)?;
        if stage == Stage::Stage2 {
            for tokens in &config.clusters.grid {
                let stored = tokens.of(scene.num_tokens)?;
                let scene = SceneSizes { num_storage_tokens: Some(stored), num_render_tokens: stored, ..scene };
                let [encoder, condenser, renderer] =
                    [Part::Encoder, Part::Condenser, Part::Renderer].map(|part| part_macs(config, part, &scene));
                macs += encoder + 3.0 * (condenser + renderer);
                count += 1;
            }
            continue;
        }
        let [low, high] = config.stage1.keep_tokens;
        for point in 0..NUM_SHARES {
            let share = low + (high - low) * (point as f64 + 0.5) / NUM_SHARES as f64;
            let kept = ((scene.num_tokens as f64 * share) as usize).max(1);
            let scene = SceneSizes { num_render_tokens: kept, is_per_view: kept < scene.num_tokens, ..scene };
            macs += 3.0 * (part_macs(config, Part::Encoder, &scene) + part_macs(config, Part::Renderer, &scene));
            count += 1;
        }
    }
    Ok(config.stage(stage).batch_size.div_ceil(num_ranks) as f64 * macs / f64::from(count))
}

/// Returns the multiply-accumulates of the cluster cache, without K-means; 0 where the number of scenes depends on the data.
fn cluster_macs(config: &Config) -> Result<f64, TrainError> {
    let (clusters, data) = (&config.clusters, &config.data);
    let num_scenes = match (clusters.num_scenes, data.source) {
        (0, SourceKind::Synthetic) => data.synthetic.num_scenes,
        (count, SourceKind::Synthetic) => count.min(data.synthetic.num_scenes),
        (count, _) => count,
    };
    if !clusters.grouping.reads_tokens() {
        return Ok(0.0);
    }
    let scene = scene(config, data.views.max_context, 0)?;
    Ok((num_scenes * clusters.num_passes) as f64 * part_macs(config, Part::Encoder, &scene))
}

fn evaluation_macs(config: &Config) -> Result<f64, TrainError> {
    let eval = &config.eval;
    let scene = scene(config, eval.num_context, eval.num_targets)?;
    let planned = planned_eval(config);
    let mut macs = part_macs(config, Part::Encoder, &scene);
    for count in config.eval_stored_tokens() {
        let count = count.of(scene.num_tokens)?;
        let scene = SceneSizes { num_storage_tokens: Some(count), num_render_tokens: count, ..scene };
        macs += part_macs(config, Part::Condenser, &scene);
        for num_render_tokens in planned.token_counts(count) {
            let scene = SceneSizes { num_render_tokens, ..scene };
            let of_views = config.model.render_views_macs(config.data.height, config.data.width, &scene)?;
            macs += of_views.count(FlopConvention::Macs) as f64;
        }
    }
    Ok(eval.num_scenes as f64 * macs)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_time_left_is_that_of_the_later_work() {
        let mut config = Config { run_dir: "run".into(), ..Config::default() };
        (config.stage1.steps, config.clusters.num_scenes, config.eval.num_scenes) = (100, 1, 2);
        let of = |config: &Config, stage| update_macs(config, stage, 1).expect("valid");
        let stage1 = of(&config, Stage::Stage1);
        let tail = cluster_macs(&config).expect("valid")
            + config.stage2.steps as f64 * of(&config, Stage::Stage2)
            + evaluation_macs(&config).expect("valid");
        let estimate = |config: &Config, step| estimate_run(config, 1, Stage::Stage1, step, 2.0).expect("valid");
        let assert_left = |config: &Config, step, macs: f64| {
            let left = estimate(config, step).remaining_s;
            assert!((left / (2.0 * macs) - 1.0).abs() < 1e-9, "{left} {macs}");
        };
        assert!((estimate(&config, 1).flops_per_s / stage1 - 1.0).abs() < 1e-9, "two operations each, in two seconds");
        assert_left(&config, 1, 99.0 + tail / stage1);
        config.stage1.half_resolution = 0.5;
        let half = of(&Config { data: config.data.at_half_resolution(), ..config.clone() }, Stage::Stage1);
        assert_left(&config, 40, 10.0 + (50.0 * stage1 + tail) / half);
        assert_left(&config, 60, 40.0 + tail / stage1);
    }
}
