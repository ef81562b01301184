//! `clift plan`: parameters, memory and time of a run before it starts.
//!
//! Parameters and multiply-accumulates are counted; memory is counted from the tensors that the operations store for the
//! backward. Seconds are those of a shallow network, timed on the device and scaled to the multiply-accumulates of the whole.
//! `docs/results/performance.md` compares plans with measured runs.

use clift_data::SourceKind;
use clift_eval::available_bytes;
use clift_model::{DeviceName, FlopConvention, ModelConfig, Parameters, Part, SceneSizes};
use clift_train::{
    BatchParts, Config, RunStep, Stage, StageSettings, TrainError, cluster_counts, eval_sizes, num_tokens, peak_bytes,
    possible_sizes, scene_with_all_tokens, scene_with_stored_tokens, typical_sizes,
};
use serde::Serialize;

use crate::allreduce::sent_bytes;
use crate::plan::calibration::{InferenceRates, inference_rates, loading_s, part_macs, update_macs, update_rates};

/// How a run is planned.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlanOptions {
    /// Whether a short calibration on the device gives times.
    pub is_timed: bool,
    /// Ranks that share batches and scenes, one device each.
    pub num_ranks: usize,
    /// Bytes per second that a rank sends in the sum over ranks; `None` leaves its time out.
    pub sent_bytes_per_s: Option<f64>,
}

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
    /// Mean seconds of a unit on the device; `None` without timing.
    pub compute_s: Option<f64>,
    /// Mean number of busy threads of this process during an update.
    pub busy_threads: Option<f64>,
    /// Seconds that one thread takes to read and decode a unit; `None` without timing or without data.
    pub loading_s: Option<f64>,
    /// Seconds between two units: computation and loading as far as they do not overlap.
    pub seconds: Option<f64>,
}

impl PartPlan {
    /// Returns the seconds of all units.
    pub fn total_s(&self) -> Option<f64> {
        Some(self.seconds? * self.count? as f64)
    }
}

/// Estimates a run of `config`, for the rank with the most work.
///
/// # Errors
/// [`TrainError::BadConfig`] for impossible values, and those of the device.
pub fn plan(config: &Config, options: &PlanOptions) -> Result<Plan, TrainError> {
    check_plan(config)?;
    let PlanOptions { is_timed, num_ranks, sent_bytes_per_s } = *options;
    let parameters = Parameters::of(&config.model);
    let views = &config.data.views;
    let share = |part: PartPlan| PartPlan { count: part.count.map(|count| count.div_ceil(num_ranks as u64)), ..part };
    let part = |&run_step: &RunStep| match run_step {
        RunStep::Train(stage) => update(config, stage, &parameters, options),
        RunStep::Clusters => clusters(config, is_timed).map(share),
        RunStep::Eval => evaluation(config, is_timed).map(share),
    };
    let parts = config.run_steps().iter().map(part).collect::<Result<Vec<_>, _>>()?;
    let mut plan = Plan {
        num_ranks,
        device: config.device,
        threads: rayon::current_num_threads(),
        parameters,
        num_tokens: [num_tokens(config, views.min_context)?, num_tokens(config, views.max_context)?],
        available_bytes: available_bytes(config.device),
        parts,
    };
    let per_view_s = if is_timed { loading_s(config) } else { None };
    // Photos are read at the whole size and then reduced; small images of synthetic scenes are drawn faster.
    let of_stage1 = match &sizes(config, Stage::Stage1)[..] {
        sizes @ [_, _] if is_timed && config.data.source == SourceKind::Synthetic => {
            sizes.iter().map(|(share, config)| Some(share * loading_s(config)?)).sum()
        }
        _ => per_view_s,
    };
    for part in &mut plan.parts {
        let (num_views, num_threads) = views_and_threads(config, part.part, num_ranks);
        let is_stage1 = part.part == Stage::Stage1.name();
        part.loading_s = if is_stage1 { of_stage1 } else { per_view_s }.map(|seconds| seconds * num_views);
        part.seconds = part.compute_s.map(|compute| {
            let busy = part.busy_threads.filter(|_| config.device.is_cpu());
            let shared = busy.map(|busy| SharedCores { cores: plan.threads as f64, busy });
            let sum_s = sent_bytes_per_s.map_or(0.0, |rate| part.sent_bytes as f64 / rate);
            seconds_per_unit(compute + sum_s, part.loading_s.unwrap_or(0.0), num_threads, shared)
        });
    }
    Ok(plan)
}

/// Returns the most scenes of a batch that a rank works off, and the batch's parts.
fn scenes_of_rank(config: &Config, stage: Stage, num_ranks: usize) -> (usize, BatchParts) {
    let StageSettings { batch_size, accumulate, .. } = config.stage(stage);
    let parts = |rank| BatchParts::of_rank(batch_size, accumulate, rank, num_ranks);
    let most = (0..num_ranks).map(|rank| parts(rank).slots().count()).max().unwrap_or_default();
    (most, parts(0))
}

/// Returns the mean number of views that a unit of a part reads, and the number of threads that read ahead.
fn views_and_threads(config: &Config, part: &str, num_ranks: usize) -> (f64, usize) {
    let views = &config.data.views;
    let contexts = f64::midpoint(views.min_context as f64, views.max_context as f64);
    let batch = |stage| scenes_of_rank(config, stage, num_ranks).0 as f64 * (contexts + views.num_targets as f64);
    match part {
        "stage1" => (batch(Stage::Stage1), config.data.num_threads),
        "stage2" => (batch(Stage::Stage2), config.data.num_threads),
        "clusters" => (contexts, 0),
        _ => ((config.eval.num_context + config.eval.num_targets) as f64, 0),
    }
}

/// Cores that a CPU device shares with the loading threads.
#[derive(Clone, Copy, Debug)]
struct SharedCores {
    cores: f64,
    /// Cores that the computation keeps busy.
    busy: f64,
}

/// Returns the seconds between two units that each take `compute_s` on the device and `loading_s` on one of `num_threads`
/// loading threads, which use the idle cores of `shared`.
fn seconds_per_unit(compute_s: f64, loading_s: f64, num_threads: usize, shared: Option<SharedCores>) -> f64 {
    if num_threads == 0 {
        return compute_s + loading_s;
    }
    let added_s = shared.map_or(0.0, |SharedCores { cores, busy }| {
        let fits_s = (cores - busy).max(0.0) * compute_s;
        (loading_s - fits_s).max(0.0) / cores
    });
    (compute_s + added_s).max(loading_s / num_threads as f64)
}

/// Does [`Config::validate`] and [`Config::validate_half_resolution`] without requiring `data.root`.
///
/// # Errors
/// Those of both.
pub fn check_plan(config: &Config) -> Result<(), TrainError> {
    let mut config = config.clone();
    config.data.root.get_or_insert_with(Default::default);
    config.validate()?;
    config.validate_half_resolution()
}

/// Lists the weight files that training or evaluation needs and does not find. A plan does without them.
pub fn missing_weights(config: &Config) -> Vec<String> {
    let perceptual = config.loss.weights().err();
    let perceptual = perceptual.map(|error| format!("{error}; the plan times random weights, `clift train` stops"));
    let lpips = config.eval.lpips_path().filter(|path| !path.is_file());
    let lpips = lpips.map(|path| {
        format!("`eval.lpips_weights` = {}: file not found; LPIPS is not timed, `clift train` stops", path.display())
    });
    perceptual.into_iter().chain(lpips).collect()
}

fn update(
    config: &Config,
    stage: Stage,
    parameters: &Parameters,
    options: &PlanOptions,
) -> Result<PartPlan, TrainError> {
    let PlanOptions { is_timed, num_ranks, .. } = *options;
    let (batch_size, parts) = scenes_of_rank(config, stage, num_ranks);
    let images = (batch_size * config.data.views.num_targets) as f64;
    let trained_parameters = parameters.of_parts(stage.trained());
    let (mut macs, mut compute_s, mut busy_threads) = (0.0, is_timed.then_some(0.0), is_timed.then_some(0.0));
    // The mean step of the stage. Small images take more time per operation, and so are timed on their own.
    for (share, config) in sizes(config, stage) {
        let macs_of_size = batch_size as f64 * mean_macs_of_scene(&config, stage)?;
        macs += share * macs_of_size;
        if let (Some(compute_s), Some(busy_threads)) = (&mut compute_s, &mut busy_threads) {
            let rates = update_rates(&config, stage, &typical_sizes(&config, stage)?)?;
            let fixed_s = trained_parameters as f64 * rates.per_parameter + images * rates.per_image;
            *compute_s += share * (macs_of_size * rates.per_mac + fixed_s);
            *busy_threads += share * rates.busy;
        }
    }
    let mut of_rank = config.clone();
    of_rank.set_accumulate(stage, parts.num_parts());
    let mut part = untimed(&of_rank, stage.into(), macs)?;
    if num_ranks > 1 {
        part.peak_bytes += sum_bytes(trained_parameters, num_ranks);
        // A part of every round is sent to the ranks that add it up, and once the sum to the others.
        let both = sent_bytes(trained_parameters, num_ranks);
        part.sent_bytes = both / 2 * (parts.num_rounds() as u64 + 1);
    }
    let count = Some(config.stage(stage).steps);
    Ok(PartPlan { unit: "step", count, trained_parameters, compute_s, busy_threads, ..part })
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

fn clusters(config: &Config, is_timed: bool) -> Result<PartPlan, TrainError> {
    let views = &config.data.views;
    let num_context = usize::midpoint(views.min_context, views.max_context);
    let reads_tokens = config.clusters.grouping.reads_tokens();
    let mut macs = 0.0;
    for num_context in (views.min_context..=views.max_context).filter(|_| reads_tokens) {
        macs += part_macs(&config.model, Part::Encoder, &scene_with_all_tokens(config, num_context, 0)?);
    }
    macs /= (views.max_context - views.min_context + 1) as f64;
    let compute_s = if !reads_tokens {
        Some(0.0)
    } else if is_timed {
        let counts = cluster_counts(config, num_tokens(config, num_context)?)?;
        let rates = inference_rates(config, num_context, 1, Some(&timed_counts(&counts)))?;
        let kmeans = counts.iter().map(|&count| kmeans_s(&rates, count)).sum::<f64>() / counts.len() as f64;
        Some(macs * rates.encode_per_mac + kmeans)
    } else {
        None
    };
    let num_scenes = match (config.clusters.num_scenes, config.data.source) {
        (0, SourceKind::Synthetic) => Some(config.data.synthetic.num_scenes),
        (0, _) => None,
        (count, SourceKind::Synthetic) => Some(count.min(config.data.synthetic.num_scenes)),
        (count, _) => Some(count),
    };
    let count = num_scenes.map(|count| (count * config.clusters.num_passes) as u64);
    Ok(PartPlan { count, compute_s, ..untimed(config, RunStep::Clusters, macs)? })
}

fn evaluation(config: &Config, is_timed: bool) -> Result<PartPlan, TrainError> {
    let eval = &config.eval;
    let num_targets = eval.num_targets;
    let scene = scene_with_all_tokens(config, eval.num_context, num_targets)?;
    let counts =
        config.eval_stored_tokens().iter().map(|count| count.of(scene.num_tokens)).collect::<Result<Vec<_>, _>>()?;
    let sweep = eval_sizes(config);
    // Multiply-accumulates of the encoder, and of all that reads its tokens.
    let encode_and_rest = |model: &ModelConfig| -> Result<(f64, f64), TrainError> {
        let mut rest = 0.0;
        for &count in &counts {
            let scene = scene_with_stored_tokens(scene, count);
            rest += part_macs(model, Part::Condenser, &scene);
            for num_render_tokens in sweep.token_counts(count) {
                let scene = SceneSizes { num_render_tokens, ..scene };
                let macs = model.render_views_macs(config.data.height, config.data.width, &scene)?;
                rest += macs.count(FlopConvention::Macs) as f64;
            }
        }
        Ok((part_macs(model, Part::Encoder, &scene), rest))
    };
    let (encoder, rest) = encode_and_rest(&config.model)?;
    let compute_s = if is_timed {
        let rates = inference_rates(config, eval.num_context, num_targets, None)?;
        let (timed_encoder, timed_rest) = encode_and_rest(&rates.timed)?;
        Some(
            rates.evaluation_s
                + (encoder - timed_encoder).max(0.0) * rates.encode_per_mac
                + (rest - timed_rest).max(0.0) * rates.render_per_mac,
        )
    } else {
        None
    };
    let count = (eval.num_scenes > 0).then_some(eval.num_scenes as u64);
    Ok(PartPlan { count, compute_s, ..untimed(config, RunStep::Eval, encoder + rest)? })
}

/// Returns the counted values of a step that trains no parameters.
fn untimed(config: &Config, run_step: RunStep, macs: f64) -> Result<PartPlan, TrainError> {
    Ok(PartPlan {
        part: run_step.name(),
        unit: "scene",
        count: None,
        trained_parameters: 0,
        gmacs: macs / 1e9,
        peak_bytes: peak_bytes(config, run_step)?,
        sent_bytes: 0,
        compute_s: None,
        busy_threads: None,
        loading_s: None,
        seconds: None,
    })
}

/// Returns the smallest, the middle and the largest of ascending counts.
fn timed_counts(counts: &[usize]) -> Vec<usize> {
    let Some(last) = counts.len().checked_sub(1) else { return Vec::new() };
    let mut probed = vec![counts[0], counts[last / 2], counts[last]];
    probed.dedup();
    probed
}

/// Interpolates the seconds of K-means between the timed counts.
fn kmeans_s(rates: &InferenceRates, count: usize) -> f64 {
    let timed = &rates.kmeans;
    let Some(above) = timed.iter().position(|(probed, _)| *probed >= count) else {
        return timed.last().map_or(0.0, |(_, seconds)| *seconds);
    };
    if above == 0 || timed[above].0 == count {
        return timed[above].1;
    }
    let ((low, low_s), (high, high_s)) = (timed[above - 1], timed[above]);
    low_s + (high_s - low_s) * (count - low) as f64 / (high - low) as f64
}

#[cfg(test)]
mod tests {
    use clift_model::TokenCount;

    use super::*;

    fn config() -> Config {
        let mut config = Config { run_dir: "run".into(), ..Config::default() };
        (config.data.synthetic.width, config.data.synthetic.height) = (256, 256);
        config
    }

    const UNTIMED: PlanOptions = PlanOptions { is_timed: false, num_ranks: 1, sent_bytes_per_s: None };

    #[test]
    fn ranks_share_batches_and_scenes() {
        let mut config = config();
        (config.stage1.batch_size, config.stage1.accumulate) = (16, 4);
        (config.clusters.num_scenes, config.clusters.num_passes) = (90, 1);
        let of = |num_ranks| plan(&config, &PlanOptions { num_ranks, ..UNTIMED }).expect("valid");
        let [one, two, eight] = [1, 2, 8].map(of);
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
    fn untimed_plan_has_all_parts_without_data() {
        let mut config = config();
        config.data.source = SourceKind::Chunks;
        let plan = plan(&config, &UNTIMED).expect("valid");
        assert_eq!(
            plan.parts.iter().map(|part| part.part).collect::<Vec<_>>(),
            ["stage1", "clusters", "stage2", "eval"]
        );
        assert!(plan.parts.iter().all(|part| part.seconds.is_none() && part.peak_bytes > 300 << 20));
        assert_eq!(plan.parameters.encoder + plan.parameters.renderer, 81_239_232);
        assert_eq!((plan.parts[0].count, plan.parts[1].count), (Some(90_000), None));
    }

    #[test]
    fn kmeans_seconds_are_interpolated() {
        let rates = InferenceRates {
            encode_per_mac: 0.0,
            render_per_mac: 0.0,
            kmeans: vec![(10, 1.0), (20, 2.0)],
            evaluation_s: 0.0,
            timed: ModelConfig::default(),
        };
        let seconds = [5, 10, 15, 20, 30].map(|count| kmeans_s(&rates, count));
        assert_eq!(seconds, [1.0, 1.0, 1.5, 2.0, 2.0]);
        assert_eq!(timed_counts(&[1, 2, 3, 4, 5]), [1, 3, 5]);
        assert_eq!(timed_counts(&[7]), [7]);
    }

    #[test]
    fn loading_overlaps_as_far_as_cores_allow() {
        let busy = |busy| Some(SharedCores { cores: 2.0, busy });
        assert_eq!(seconds_per_unit(1.0, 0.5, 0, busy(2.0)), 1.5);
        assert_eq!(seconds_per_unit(1.0, 0.5, 1, busy(2.0)), 1.25);
        assert_eq!(seconds_per_unit(1.0, 0.5, 1, busy(1.75)), 1.125);
        assert_eq!(seconds_per_unit(1.0, 0.5, 1, busy(1.0)), 1.0);
        assert_eq!(seconds_per_unit(1.0, 0.5, 1, None), 1.0);
        assert_eq!(seconds_per_unit(1.0, 9.0, 3, None), 3.0);
    }

    #[test]
    fn a_step_costs_the_mean_of_whole_and_half_images() {
        let of = |half_resolution: f64, width: usize| {
            let mut config = config();
            (config.data.width, config.data.height) = (width, width);
            (config.stage1.steps, config.stage1.half_resolution) = (100, half_resolution);
            plan(&config, &UNTIMED).expect("valid").parts[0].gmacs
        };
        let expected = 0.29 * of(0.0, 128) + 0.71 * of(0.0, 256);
        assert!((of(0.29, 256) / expected - 1.0).abs() < 1e-9, "{} {expected}", of(0.29, 256));
        assert_eq!(of(1.0, 256), of(0.0, 128));
    }

    #[test]
    fn small_runs_are_timed_on_cpu_devices() {
        let mut config = config();
        (config.data.width, config.data.height) = (16, 16);
        (config.model.dim, config.model.num_heads, config.model.feed_forward_dim) = (16, 2, 24);
        (config.stage1.batch_size, config.stage2.batch_size) = (2, 2);
        config.clusters.grid = vec![TokenCount::Share(0.25), TokenCount::Share(0.5)];
        config.loss.perceptual_weight = 0.5;
        config.eval.lpips_weights = Some("no/such/file".into());
        let mut half = config.clone();
        (half.stage1.half_resolution, half.loss.perceptual_weight) = (0.5, 0.0);
        for (device, config) in [(DeviceName::Flex, &config), (DeviceName::Ndarray, &config), (DeviceName::Flex, &half)]
        {
            let config = Config { device, ..config.clone() };
            assert_eq!(missing_weights(&config).len(), if config.loss.perceptual_weight > 0.0 { 2 } else { 1 });
            let plan = plan(&config, &PlanOptions { is_timed: true, ..UNTIMED }).expect("runs without weight files");
            for part in plan.parts {
                let seconds = part.seconds.expect("timed");
                assert!(seconds > 0.0 && seconds.is_finite(), "{device} {}: {seconds}", part.part);
            }
        }
    }
}
