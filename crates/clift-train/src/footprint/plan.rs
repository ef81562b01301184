//! `clift plan`: counted parameters, operations and memory of a run before it starts.
//!
//! Memory is counted from the tensors that the operations store for the backward.
//! `docs/results/performance.md` compares plans with measured runs.

use clift_data::SourceKind;
use clift_eval::available_bytes;
use clift_model::{DeviceName, FlopConvention, ModelConfig, Parameters, Part, SceneSizes};
use serde::Serialize;

use crate::config::config::Config;
use crate::distributed::parts::BatchParts;
use crate::distributed::ranks::sent_bytes;
use crate::error::TrainError;
use crate::events::{RunStep, Stage};
use crate::footprint::memory::peak_bytes;
use crate::footprint::scene_sizes::{
    num_tokens, planned_eval, possible_sizes, scene_with_all_tokens, scene_with_stored_tokens,
};
use crate::stage::settings::StageSettings;

/// Estimate of a run, for one of its ranks.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Plan {
    /// Number of ranks.
    pub num_ranks: usize,
    /// Device of the tensors.
    pub device: DeviceName,
    /// Threads of the CPU devices.
    pub threads: usize,
    /// Parameters of the networks.
    pub parameters: Parameters,
    /// Tokens of a training scene, fewest and most.
    pub num_tokens: [usize; 2],
    /// Free memory of the device; `None` if the system does not report it.
    pub available_bytes: Option<u64>,
    /// The stages and the evaluation, in the order they run.
    pub parts: Vec<PartPlan>,
}

/// Estimate of one part of a run.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PartPlan {
    /// `stage1`, `clusters`, `stage2` or `eval`.
    pub part: &'static str,
    /// Counted unit: `step` or `scene`.
    pub unit: &'static str,
    /// Number of units; scenes of one rank. `None` if it depends on the data.
    pub count: Option<u64>,
    /// Number of trained parameters.
    pub trained_parameters: u64,
    /// Mean multiply-accumulates of a unit in units of 1e9, without K-means.
    pub gmacs: f64,
    /// Peak memory of the process.
    pub peak_bytes: u64,
    /// Bytes that a rank sends per step to sum the gradients.
    pub sent_bytes: u64,
}

/// Estimates a run of `config` on `num_ranks` ranks, for the rank with the most work.
pub fn plan(config: &Config, num_ranks: usize) -> Result<Plan, TrainError> {
    check_plan(config)?;
    let parameters = Parameters::of(&config.model);
    let views = &config.data.views;
    let share = |part: PartPlan| PartPlan { count: part.count.map(|count| count.div_ceil(num_ranks as u64)), ..part };
    let part = |&run_step: &RunStep| match run_step {
        RunStep::Train(stage) => update(config, stage, &parameters, num_ranks),
        RunStep::Clusters => clusters(config).map(share),
        RunStep::Eval => evaluation(config).map(share),
    };
    Ok(Plan {
        num_ranks,
        device: config.device,
        threads: rayon::current_num_threads(),
        num_tokens: [num_tokens(config, views.min_context)?, num_tokens(config, views.max_context)?],
        available_bytes: available_bytes(config.device),
        parts: config.run_steps().iter().map(part).collect::<Result<_, _>>()?,
        parameters,
    })
}

/// Speed of a run and its remaining time, estimated from a step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RunEstimate {
    /// Floating-point operations per second of the rank with the most work.
    pub flops_per_s: f64,
    /// Seconds of the later work at this speed. Parts whose number of scenes depends on the data do not count.
    pub remaining_s: f64,
}

/// Estimates speed and remaining time of a run from the wall time `step_s` of a step of a stage, by the multiply-accumulates of the plan.
pub fn estimate_run(
    config: &Config,
    num_ranks: usize,
    stage: Stage,
    step: u64,
    step_s: f64,
) -> Result<RunEstimate, TrainError> {
    let plan = plan(config, num_ranks)?;
    let settings = config.stage(stage);
    let (batch_size, _) = scenes_of_rank(config, stage, num_ranks);
    let gmacs = |config: &Config| Ok::<f64, TrainError>(batch_size as f64 * mean_macs_of_scene(config, stage)? / 1e9);
    let whole = gmacs(config)?;
    let num_half = settings.half_resolution_steps.saturating_sub(step) as f64;
    let half = if settings.half_resolution_steps == 0 {
        whole
    } else {
        gmacs(&Config { data: config.data.at_half_resolution(), ..config.clone() })?
    };
    let mut later = num_half * half + (settings.steps.saturating_sub(step) as f64 - num_half) * whole;
    let parts = plan.parts.iter().skip_while(|part| part.part != stage.name()).skip(1);
    later += parts.map(|part| part.count.unwrap_or_default() as f64 * part.gmacs).sum::<f64>();
    let of_step = if settings.is_half_resolution(step) { half } else { whole };
    Ok(RunEstimate { flops_per_s: 2e9 * of_step / step_s, remaining_s: step_s * later / of_step })
}

/// Does [`Config::validate`] and [`Config::validate_half_resolution`] without requiring `data.root`.
pub fn check_plan(config: &Config) -> Result<(), TrainError> {
    let mut config = config.clone();
    config.data.root.get_or_insert_with(Default::default);
    config.validate()?;
    config.validate_half_resolution()
}

fn part_macs(model: &ModelConfig, network: Part, scene: &SceneSizes) -> f64 {
    model.macs(network, scene).count(FlopConvention::Macs) as f64
}

/// Returns the multiply-accumulates of one scene of an update: a backward pass counts as two forward passes, as for linear
/// layers, and activation checkpointing adds a forward pass.
fn update_macs(config: &Config, stage: Stage, scene: &SceneSizes) -> f64 {
    let [encoder, condenser, renderer] =
        [Part::Encoder, Part::Condenser, Part::Renderer].map(|network| part_macs(&config.model, network, scene));
    let passes = if config.activation_checkpointing { 4.0 } else { 3.0 };
    if stage == Stage::Stage2 { encoder + passes * (condenser + renderer) } else { passes * (encoder + renderer) }
}

/// Returns the most scenes of a batch that a rank works off, and the batch's parts.
fn scenes_of_rank(config: &Config, stage: Stage, num_ranks: usize) -> (usize, BatchParts) {
    let StageSettings { batch_size, accumulate, .. } = config.stage(stage);
    let parts = |rank| BatchParts::of_rank(batch_size, accumulate, rank, num_ranks);
    let most = (0..num_ranks).map(|rank| parts(rank).slots().count()).max().unwrap_or_default();
    (most, parts(0))
}

fn update(config: &Config, stage: Stage, parameters: &Parameters, num_ranks: usize) -> Result<PartPlan, TrainError> {
    let (batch_size, parts) = scenes_of_rank(config, stage, num_ranks);
    let trained_parameters = parameters.of_parts(stage.trained());
    let mut macs = 0.0;
    for (share, config) in sizes(config, stage) {
        macs += share * batch_size as f64 * mean_macs_of_scene(&config, stage)?;
    }
    let mut of_rank = config.clone();
    of_rank.set_accumulate(stage, parts.num_parts());
    let mut part = untrained(&of_rank, RunStep::Train(stage), macs)?;
    if num_ranks > 1 {
        part.peak_bytes += sum_bytes(trained_parameters, num_ranks);
        // A part of every round is sent to the ranks that add it up, and once the sum to the others.
        let both = sent_bytes(trained_parameters, num_ranks);
        part.sent_bytes = both / 2 * (parts.num_rounds() as u64 + 1);
    }
    Ok(PartPlan { unit: "step", count: Some(config.stage(stage).steps), trained_parameters, ..part })
}

/// Returns the config for every size of the images of a stage, with its share of the steps.
fn sizes(config: &Config, stage: Stage) -> Vec<(f64, Config)> {
    let StageSettings { steps, half_resolution_steps, .. } = config.stage(stage);
    let half = half_resolution_steps as f64 / steps.max(1) as f64;
    let small = Config { data: config.data.at_half_resolution(), ..config.clone() };
    let sizes = [(1.0 - half, config.clone()), (half, small)];
    sizes.into_iter().filter(|(share, _)| *share > 0.0).collect()
}

/// Returns the multiply-accumulates of a scene of an update, the mean over all sizes that it can have.
fn mean_macs_of_scene(config: &Config, stage: Stage) -> Result<f64, TrainError> {
    let all = possible_sizes(config, stage)?;
    Ok(all.iter().map(|scene| update_macs(config, stage, scene)).sum::<f64>() / all.len() as f64)
}

/// Returns the memory of a sum over ranks: the gradients in one vector, those received, the own range, and the blocks that
/// are copied from the device.
fn sum_bytes(num_values: u64, num_ranks: usize) -> u64 {
    const MAX_COPIED: u64 = 2 * (64 << 20);
    let bytes = 4 * num_values;
    2 * bytes + bytes / num_ranks as u64 + MAX_COPIED.min(2 * bytes)
}

fn clusters(config: &Config) -> Result<PartPlan, TrainError> {
    let views = &config.data.views;
    let mut macs = 0.0;
    if config.clusters.grouping.reads_tokens() {
        for num_context in views.min_context..=views.max_context {
            macs += part_macs(&config.model, Part::Encoder, &scene_with_all_tokens(config, num_context, 0)?);
        }
        macs /= (views.max_context - views.min_context + 1) as f64;
    }
    let num_scenes = match (config.clusters.num_scenes, config.data.source) {
        (0, SourceKind::Synthetic) => Some(config.data.synthetic.num_scenes),
        (0, _) => None,
        (count, SourceKind::Synthetic) => Some(count.min(config.data.synthetic.num_scenes)),
        (count, _) => Some(count),
    };
    let count = num_scenes.map(|count| (count * config.clusters.num_passes) as u64);
    Ok(PartPlan { count, ..untrained(config, RunStep::Clusters, macs)? })
}

fn evaluation(config: &Config) -> Result<PartPlan, TrainError> {
    let eval = &config.eval;
    let scene = scene_with_all_tokens(config, eval.num_context, eval.num_targets)?;
    let planned = planned_eval(config);
    let mut macs = part_macs(&config.model, Part::Encoder, &scene);
    for count in config.eval_stored_tokens() {
        let count = count.of(scene.num_tokens)?;
        let scene = scene_with_stored_tokens(scene, count);
        macs += part_macs(&config.model, Part::Condenser, &scene);
        for num_render_tokens in planned.token_counts(count) {
            let scene = SceneSizes { num_render_tokens, ..scene };
            let of_views = config.model.render_views_macs(config.data.height, config.data.width, &scene)?;
            macs += of_views.count(FlopConvention::Macs) as f64;
        }
    }
    let count = (eval.num_scenes > 0).then_some(eval.num_scenes as u64);
    Ok(PartPlan { count, ..untrained(config, RunStep::Eval, macs)? })
}

/// Returns the estimate of a step of a run that trains no parameters, without its number of scenes.
fn untrained(config: &Config, run_step: RunStep, macs: f64) -> Result<PartPlan, TrainError> {
    Ok(PartPlan {
        part: run_step.name(),
        unit: "scene",
        count: None,
        trained_parameters: 0,
        gmacs: macs / 1e9,
        peak_bytes: peak_bytes(config, run_step)?,
        sent_bytes: 0,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn config() -> Config {
        let mut config = Config { run_dir: "run".into(), ..Config::default() };
        (config.data.synthetic.width, config.data.synthetic.height) = (256, 256);
        config
    }

    #[test]
    fn ranks_share_batches_and_scenes() {
        let mut config = config();
        (config.stage1.batch_size, config.stage1.accumulate) = (16, 4);
        (config.clusters.num_scenes, config.clusters.num_passes) = (90, 1);
        let [one, two, eight] = [1, 2, 8].map(|num_ranks| plan(&config, num_ranks).expect("valid"));
        let stage1 = |plan: &Plan| plan.parts[0].clone();
        assert_eq!((stage1(&one).sent_bytes, eight.num_ranks), (0, 8));
        let ratio = stage1(&one).gmacs / stage1(&eight).gmacs;
        assert!((ratio - 8.0).abs() < 1e-9, "{ratio}");
        assert!(stage1(&eight).peak_bytes < stage1(&one).peak_bytes, "parts of two scenes instead of four");
        let bytes = 4 * stage1(&one).trained_parameters;
        // Two rounds and the sums; one round and the sums.
        assert_eq!([stage1(&two).sent_bytes, stage1(&eight).sent_bytes], [3 * (bytes / 2), 2 * (bytes * 7 / 8)]);
        assert_eq!([&one, &two, &eight].map(|plan| plan.parts[1].count), [Some(90), Some(45), Some(12)]);
        assert_eq!(stage1(&eight).count, stage1(&one).count);
    }

    #[test]
    fn plan_has_all_parts_without_data() {
        let mut config = config();
        config.data.source = SourceKind::Chunks;
        let plan = plan(&config, 1).expect("valid");
        assert_eq!(
            plan.parts.iter().map(|part| part.part).collect::<Vec<_>>(),
            ["stage1", "clusters", "stage2", "eval"]
        );
        assert!(plan.parts.iter().all(|part| part.gmacs > 0.0 && part.peak_bytes > 300 << 20));
        assert_eq!(plan.parameters.encoder + plan.parameters.renderer, 81_239_232);
        assert_eq!((plan.parts[0].count, plan.parts[1].count), (Some(90_000), None));
    }

    #[test]
    fn the_time_left_is_that_of_the_later_work() {
        let mut config = config();
        (config.stage1.steps, config.clusters.num_scenes, config.eval.num_scenes) = (100, 1, 2);
        let parts = plan(&config, 1).expect("valid").parts;
        let gmacs = |i: usize| parts[i].count.expect("known") as f64 * parts[i].gmacs;
        let step = parts[0].gmacs;
        let assert_left = |config: &Config, stage, step, gmacs: f64| {
            let left = estimate_run(config, 1, stage, step, 2.0).expect("valid").remaining_s;
            assert!((left / (2.0 * gmacs) - 1.0).abs() < 1e-9, "{left} {gmacs}");
        };
        let rate = estimate_run(&config, 1, Stage::Stage1, 0, 2.0).expect("valid").flops_per_s;
        assert!((rate / (1e9 * step) - 1.0).abs() < 1e-9, "two operations per multiply-accumulate in two seconds");
        assert_left(&config, Stage::Stage1, 0, (gmacs(0) + gmacs(1) + gmacs(2) + gmacs(3)) / step);
        assert_left(&config, Stage::Stage2, config.stage2.steps, gmacs(3) / parts[2].gmacs);
        config.stage1.half_resolution = 0.5;
        let half = 2.0 * plan(&config, 1).expect("valid").parts[0].gmacs - step;
        assert_left(&config, Stage::Stage1, 40, 10.0 + (50.0 * step + gmacs(1) + gmacs(2) + gmacs(3)) / half);
        assert_left(&config, Stage::Stage1, 60, 40.0 + (gmacs(1) + gmacs(2) + gmacs(3)) / step);
    }

    #[test]
    fn a_step_costs_the_mean_of_whole_and_half_images() {
        let of = |half_resolution: f64, width: usize| {
            let mut config = config();
            (config.data.width, config.data.height) = (width, width);
            (config.stage1.steps, config.stage1.half_resolution) = (100, half_resolution);
            plan(&config, 1).expect("valid").parts[0].gmacs
        };
        let expected = 0.29 * of(0.0, 128) + 0.71 * of(0.0, 256);
        assert!((of(0.29, 256) / expected - 1.0).abs() < 1e-9, "{} {expected}", of(0.29, 256));
        assert_eq!(of(1.0, 256), of(0.0, 128));
    }
}
