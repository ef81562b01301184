//! `clift plan`: parameters, memory and time of a run before it starts.
//!
//! Parameters and multiplications are counted. Memory is counted from what the hand-written operations keep. Seconds
//! come from a shallow network, timed on the device, and the multiplications of the whole one. `docs/plan.md` holds how
//! far that is from what runs then take.

mod calibration;
pub mod counts;
pub mod largest_tensor;
pub mod machine;
mod memory;
mod sizes;
mod tape;

pub use memory::drawing_bytes;

use clift_eval::vgg::VggShape;
use clift_model::ModelConfig;
use clift_model::device::DeviceName;
use serde::Serialize;

use crate::TrainError;
use crate::config::{Config, SourceKind};
use crate::events::Stage;
use calibration::{InferenceRates, InferenceTimed, inference_rates, loading_s, update_rates};
use counts::{Macs, Parameters, SceneSizes};
use memory::{InferenceSizes, UpdateSizes, inference_bytes, update_bytes};
use sizes::{batch_sizes, drawn, evaluated, largest, measures_lpips, middle, num_tokens, picture_values, update_macs};

/// Target views that an evaluation draws at once.
const VIEWS_PER_PASS: usize = 8;

/// What a run is going to take.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Plan {
    /// Where tensors are.
    pub device: DeviceName,
    /// Threads of the CPU devices.
    pub threads: usize,
    /// Parameters of the networks.
    pub parameters: Parameters,
    /// Tokens of a training scene, fewest and most.
    pub num_tokens: [usize; 2],
    /// Memory that the device has to give; `None` where the system does not tell.
    pub available_bytes: Option<u64>,
    /// Both stages, the cluster cache and the evaluation, in the order they run.
    pub parts: Vec<PartPlan>,
}

/// What one part of a run takes.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PartPlan {
    /// `stage1`, `clusters`, `stage2` or `eval`.
    pub part: &'static str,
    /// What is counted: optimiser updates or scenes.
    pub unit: &'static str,
    /// How many; `None` where only the data tells.
    pub count: Option<u64>,
    /// Parameters it trains.
    pub trained_parameters: u64,
    /// Multiplications of one, on average, in units of 1e9; without K-means.
    pub gmacs: f64,
    /// Most memory of the process.
    pub peak_bytes: u64,
    /// Seconds of one on the device, on average; `None` where it was not asked for.
    pub compute_s: Option<f64>,
    /// Threads of this process at work meanwhile, on average; of updates alone.
    pub busy_threads: Option<f64>,
    /// Seconds of one on one thread that reads and decodes; `None` where it was not asked for or the data is not there.
    pub loading_s: Option<f64>,
    /// Seconds from one to the next: both, as far as they do not overlap.
    pub seconds: Option<f64>,
}

impl PartPlan {
    /// Seconds of all of them.
    pub fn total_s(&self) -> Option<f64> {
        Some(self.seconds? * self.count? as f64)
    }
}

/// Counts what a run of `config` takes; `is_timed` runs a short calibration on its device as well.
///
/// # Errors
/// [`TrainError::BadConfig`] for values that cannot be, and what the device gives.
pub fn plan(config: &Config, is_timed: bool) -> Result<Plan, TrainError> {
    check(config)?;
    let parameters = Parameters::of(&config.model);
    let views = &config.data.views;
    let mut plan = Plan {
        device: config.device,
        threads: rayon::current_num_threads(),
        parameters,
        num_tokens: [num_tokens(config, views.min_context)?, num_tokens(config, views.max_context)?],
        available_bytes: machine::available_bytes(config.device),
        parts: Vec::new(),
    };
    for part in [Stage::Stage1, Stage::Clusters, Stage::Stage2] {
        plan.parts.push(match part {
            Stage::Clusters => clusters(config, &parameters, is_timed)?,
            stage => update(config, stage, &parameters, is_timed)?,
        });
    }
    plan.parts.push(evaluation(config, &parameters, is_timed)?);
    let per_view_s = if is_timed { loading_s(config) } else { None };
    for part in &mut plan.parts {
        let (num_views, num_threads) = read_for(config, part.part);
        part.loading_s = per_view_s.map(|seconds| seconds * num_views);
        part.seconds = part.compute_s.map(|compute| {
            let is_cpu = matches!(config.device, DeviceName::Flex | DeviceName::Ndarray);
            let idle = part.busy_threads.filter(|_| is_cpu).map(|busy| Idle { cores: plan.threads as f64, busy });
            from_one_to_the_next(compute, part.loading_s.unwrap_or(0.0), num_threads, idle)
        });
    }
    Ok(plan)
}

/// Views that one step or scene of a part reads, on average, and the threads that read them beside the work.
fn read_for(config: &Config, part: &str) -> (f64, usize) {
    let views = &config.data.views;
    let contexts = f64::midpoint(views.min_context as f64, views.max_context as f64);
    let batch = |batch_size: usize| batch_size as f64 * (contexts + views.num_targets as f64);
    match part {
        "stage1" => (batch(config.stage1.batch_size), config.data.num_threads),
        "stage2" => (batch(config.stage2.batch_size), config.data.num_threads),
        "clusters" => (contexts, 0),
        _ => ((config.eval.num_context + config.eval.num_targets) as f64, 0),
    }
}

/// Cores that a CPU device shares with the threads that load ahead.
#[derive(Clone, Copy, Debug)]
struct Idle {
    cores: f64,
    /// Those that the work itself keeps busy.
    busy: f64,
}

/// Seconds between two steps of which each takes `compute_s` on the device and `loading_s` on one of `num_threads`
/// threads that load ahead, on cores that the work leaves idle where they are `shared`.
fn from_one_to_the_next(compute_s: f64, loading_s: f64, num_threads: usize, shared: Option<Idle>) -> f64 {
    if num_threads == 0 {
        return compute_s + loading_s;
    }
    let added_s = shared.map_or(0.0, |Idle { cores, busy }| {
        let fits_s = (cores - busy).max(0.0) * compute_s;
        (loading_s - fits_s).max(0.0) / cores
    });
    (compute_s + added_s).max(loading_s / num_threads as f64)
}

/// What [`Config::validate`] asks, but for where the data is: a plan needs none.
///
/// # Errors
/// As [`Config::validate`].
pub fn check(config: &Config) -> Result<(), TrainError> {
    let mut config = config.clone();
    config.data.root.get_or_insert_with(Default::default);
    config.validate()
}

/// The first part whose memory is beyond the device's, in words, with what would help.
pub fn memory_warning(config: &Config, plan: &Plan) -> Option<String> {
    let available = plan.available_bytes?;
    let part = plan.parts.iter().filter(|part| part.peak_bytes > available).max_by_key(|part| part.peak_bytes)?;
    let gib = |bytes: u64| bytes as f64 / f64::from(1 << 30);
    let needs = format!(
        "{} needs about {:.1} GiB, and {:.1} GiB are there on {}",
        part.part,
        gib(part.peak_bytes),
        gib(available),
        plan.device
    );
    let stage = match part.part {
        "stage1" => Stage::Stage1,
        "stage2" => Stage::Stage2,
        _ => return Some(format!("{needs}: fewer context views, or smaller ones, would fit")),
    };
    let fits = |config: &Config| {
        let part = update(config, stage, &plan.parameters, false);
        part.is_ok_and(|part| part.peak_bytes <= available)
    };
    let (batch_size, _) = batch_sizes(config, stage);
    let was_recomputed = config.recompute;
    for recompute in [config.recompute, true] {
        let mut config = Config { recompute, ..config.clone() };
        let also = if recompute && !was_recomputed { "recompute = true and " } else { "" };
        for parts in 1..=batch_size {
            match stage {
                Stage::Stage2 => config.stage2.accumulate = parts,
                _ => config.stage1.accumulate = parts,
            }
            if fits(&config) {
                return Some(format!("{needs}: {also}{}.accumulate = {parts} would fit", part.part));
            }
        }
    }
    Some(format!("{needs}: even one scene at a time with recompute = true does not fit"))
}

fn update(config: &Config, stage: Stage, parameters: &Parameters, is_timed: bool) -> Result<PartPlan, TrainError> {
    let (batch_size, part_size) = batch_sizes(config, stage);
    let (part, steps) = match stage {
        Stage::Stage2 => ("stage2", config.stage2.steps),
        _ => ("stage1", config.stage1.steps),
    };
    let all = drawn(config, stage)?;
    let macs_of_scene = all.iter().map(|scene| update_macs(config, stage, scene)).sum::<f64>() / all.len() as f64;
    let macs = batch_size as f64 * macs_of_scene;
    let trained_parameters = parameters.trained(stage);
    let rates = is_timed.then(|| update_rates(config, stage, &middle(config, stage)?)).transpose()?;
    let pictures = (batch_size * config.data.views.num_targets) as f64;
    let compute_s = rates.map(|rates| {
        macs * rates.per_mac + trained_parameters as f64 * rates.per_parameter + pictures * rates.per_picture
    });
    let sizes = UpdateSizes {
        stage,
        num_scenes: part_size as f64,
        is_accumulated: part_size < batch_size,
        recompute: config.recompute,
        scene: largest(config, stage)?,
        num_picture_values: picture_values(config),
        perceptual: (config.loss.perceptual_weight > 0.0)
            .then(|| VggShape::VGG19.sizes(config.data.height, config.data.width)),
    };
    // Batches prepared ahead, as bytes.
    let waiting = (config.data.num_prefetch + 1) as f64 * batch_size as f64 * picture_values(config);
    let bytes = update_bytes(&config.model, &sizes) + waiting;
    Ok(PartPlan {
        part,
        unit: "step",
        count: Some(steps),
        trained_parameters,
        gmacs: macs / 1e9,
        peak_bytes: machine::own_bytes() + bytes as u64,
        compute_s,
        busy_threads: rates.map(|rates| rates.busy),
        loading_s: None,
        seconds: None,
    })
}

fn clusters(config: &Config, parameters: &Parameters, is_timed: bool) -> Result<PartPlan, TrainError> {
    let views = &config.data.views;
    let num_context = usize::midpoint(views.min_context, views.max_context);
    let most = num_tokens(config, views.max_context)?;
    let counts = |num_tokens: usize| {
        let counts = config.clusters.grid.iter().map(|count| count.of(num_tokens));
        let counts = counts.collect::<Result<Vec<_>, _>>();
        counts.map(|mut counts| {
            counts.sort_unstable();
            counts
        })
    };
    let scene = |num_context: usize| inference_scene(config, num_context, 0);
    let mut macs = 0.0;
    for num_context in views.min_context..=views.max_context {
        macs += Macs::of(&config.model, &scene(num_context)?).encoder;
    }
    macs /= (views.max_context - views.min_context + 1) as f64;
    let compute_s = if is_timed {
        let counts = counts(num_tokens(config, num_context)?)?;
        let timed = InferenceTimed { num_context, num_targets: 1, counts: &probed(&counts), is_measured: false };
        let rates = inference_rates(config, &timed)?;
        let kmeans = counts.iter().map(|&count| kmeans_s(&rates, count)).sum::<f64>() / counts.len() as f64;
        Some(macs * rates.encode_per_mac + kmeans)
    } else {
        None
    };
    let sizes = InferenceSizes {
        num_tokens: most as f64,
        num_clusters: counts(most)?.last().map(|&count| count as f64),
        num_targets: 0.0,
        num_patches: num_tokens(config, 1)? as f64,
        num_picture_values: picture_values(config),
        num_loaded: (parameters.encoder + parameters.renderer) as f64,
        lpips: None,
    };
    let num_scenes = match (config.clusters.num_scenes, config.data.source) {
        (0, SourceKind::Synthetic) => Some(config.data.synthetic.num_scenes),
        (0, _) => None,
        (count, SourceKind::Synthetic) => Some(count.min(config.data.synthetic.num_scenes)),
        (count, _) => Some(count),
    };
    Ok(PartPlan {
        part: "clusters",
        unit: "scene",
        count: num_scenes.map(|count| (count * config.clusters.num_passes) as u64),
        trained_parameters: 0,
        gmacs: macs / 1e9,
        peak_bytes: machine::own_bytes() + inference_bytes(&config.model, parameters.total as f64, &sizes) as u64,
        compute_s,
        busy_threads: None,
        loading_s: None,
        seconds: None,
    })
}

fn evaluation(config: &Config, parameters: &Parameters, is_timed: bool) -> Result<PartPlan, TrainError> {
    let eval = &config.eval;
    let all = num_tokens(config, eval.num_context)?;
    let stored = eval.storage.iter().map(|count| count.of(all)).collect::<Result<Vec<_>, _>>()?;
    let num_targets = eval.num_targets;
    let sweep = evaluated(config);
    let scene = |stored: usize, drawn_from: usize| SceneSizes {
        num_storage_tokens: Some(stored as f64),
        num_render_tokens: drawn_from as f64,
        num_targets: num_targets as f64,
        ..inference_scene_unchecked(config, all)
    };
    // Multiplications of the encoder, and of all that is done with its tokens.
    let macs_of = |model: &ModelConfig| {
        let mut macs = (0.0, 0.0);
        for &stored in &stored {
            let once = Macs::of(model, &scene(stored, stored));
            let drawn = sweep.drawn(stored).into_iter().map(|count| Macs::of(model, &scene(stored, count)).renderer);
            macs = (once.encoder, macs.1 + once.condenser + drawn.sum::<f64>());
        }
        macs
    };
    let (encoder, rest) = macs_of(&config.model);
    let compute_s = if is_timed {
        let timed = InferenceTimed { num_context: eval.num_context, num_targets, counts: &[], is_measured: true };
        let rates = inference_rates(config, &timed)?;
        // What the timed network lacks of the whole one.
        let (of_encoder, of_rest) = macs_of(&rates.timed);
        Some(
            rates.measuring_s
                + (encoder - of_encoder).max(0.0) * rates.encode_per_mac
                + (rest - of_rest).max(0.0) * rates.render_per_mac,
        )
    } else {
        None
    };
    let num_drawn: usize = stored.iter().map(|&count| sweep.drawn(count).len()).sum();
    let sizes = InferenceSizes {
        num_tokens: all as f64,
        num_clusters: stored.iter().max().map(|&count| count as f64),
        num_targets: num_targets.min(VIEWS_PER_PASS) as f64,
        num_patches: num_tokens(config, 1)? as f64,
        // Pictures of every count and variant are held until the scene is measured.
        num_picture_values: (num_targets * (num_drawn + 3) * config.data.width * config.data.height * 3) as f64,
        num_loaded: (parameters.condenser + parameters.renderer) as f64,
        lpips: measures_lpips(config)
            .then(|| (VggShape::VGG16.sizes(config.data.height, config.data.width), num_targets as f64)),
    };
    // Both stages have a renderer of their own.
    let weights = (parameters.total + parameters.renderer) as f64;
    Ok(PartPlan {
        part: "eval",
        unit: "scene",
        count: (eval.num_scenes > 0).then_some(eval.num_scenes as u64),
        trained_parameters: 0,
        gmacs: (encoder + rest) / 1e9,
        peak_bytes: machine::own_bytes() + inference_bytes(&config.model, weights, &sizes) as u64,
        compute_s,
        busy_threads: None,
        loading_s: None,
        seconds: None,
    })
}

fn inference_scene(config: &Config, num_context: usize, num_targets: usize) -> Result<SceneSizes, TrainError> {
    let all = num_tokens(config, num_context)?;
    Ok(SceneSizes { num_targets: num_targets as f64, ..inference_scene_unchecked(config, all) })
}

fn inference_scene_unchecked(config: &Config, num_tokens: usize) -> SceneSizes {
    let patch = config.model.patch_size;
    SceneSizes {
        num_tokens: num_tokens as f64,
        num_storage_tokens: None,
        num_render_tokens: num_tokens as f64,
        is_per_view: false,
        num_targets: 0.0,
        num_patches: ((config.data.width / patch) * (config.data.height / patch)) as f64,
    }
}

/// The smallest, the middle and the largest of some rising counts.
fn probed(counts: &[usize]) -> Vec<usize> {
    let Some(last) = counts.len().checked_sub(1) else { return Vec::new() };
    let mut probed = vec![counts[0], counts[last / 2], counts[last]];
    probed.dedup();
    probed
}

/// Seconds of K-means at a count, on the line between those that were timed.
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

    #[test]
    fn a_plan_has_every_part_and_needs_no_data_and_no_time() {
        let mut config = config();
        config.data.source = SourceKind::Chunks;
        let plan = plan(&config, false).expect("valid");
        assert_eq!(
            plan.parts.iter().map(|part| part.part).collect::<Vec<_>>(),
            ["stage1", "clusters", "stage2", "eval"]
        );
        assert!(plan.parts.iter().all(|part| part.seconds.is_none() && part.peak_bytes > 300 << 20));
        assert_eq!(plan.parameters.encoder + plan.parameters.renderer, 81_239_232);
        assert_eq!((plan.parts[0].count, plan.parts[1].count), (Some(90_000), None));
    }

    #[test]
    fn too_much_memory_is_said_with_the_smallest_change_that_fits() {
        let mut config = config();
        config.data.views.max_context = 4;
        let mut planned = plan(&config, false).expect("valid");
        planned.available_bytes = Some(u64::MAX);
        assert_eq!(memory_warning(&config, &planned), None);
        planned.available_bytes = Some(planned.parts[0].peak_bytes.max(planned.parts[2].peak_bytes) - 1);
        let warning = memory_warning(&config, &planned).expect("one part is too large");
        assert!(warning.contains(".accumulate = 2 would fit"), "{warning}");
        // Less than stage 2, the largest, takes scene by scene.
        let mut one_by_one = config.clone();
        one_by_one.stage2.accumulate = config.stage2.batch_size;
        let least = plan(&one_by_one, false).expect("valid");
        planned.available_bytes = Some(least.parts[2].peak_bytes - 1);
        let warning = memory_warning(&config, &planned).expect("too large");
        assert!(warning.contains("recompute = true and stage"), "{warning}");
        planned.available_bytes = Some(1 << 20);
        let warning = memory_warning(&config, &planned).expect("too large");
        assert!(warning.ends_with("even one scene at a time with recompute = true does not fit"), "{warning}");
    }

    #[test]
    fn the_seconds_of_clustering_lie_on_a_line() {
        let rates = InferenceRates {
            encode_per_mac: 0.0,
            render_per_mac: 0.0,
            kmeans: vec![(10, 1.0), (20, 2.0)],
            measuring_s: 0.0,
            timed: ModelConfig::default(),
        };
        let seconds = [5, 10, 15, 20, 30].map(|count| kmeans_s(&rates, count));
        assert_eq!(seconds, [1.0, 1.0, 1.5, 2.0, 2.0]);
        assert_eq!(probed(&[1, 2, 3, 4, 5]), [1, 3, 5]);
        assert_eq!(probed(&[7]), [7]);
    }

    #[test]
    fn loading_is_hidden_behind_the_work_as_far_as_threads_and_cores_allow() {
        let busy = |busy| Some(Idle { cores: 2.0, busy });
        assert_eq!(from_one_to_the_next(1.0, 0.5, 0, busy(2.0)), 1.5);
        assert_eq!(from_one_to_the_next(1.0, 0.5, 1, busy(2.0)), 1.25);
        assert_eq!(from_one_to_the_next(1.0, 0.5, 1, busy(1.75)), 1.125);
        assert_eq!(from_one_to_the_next(1.0, 0.5, 1, busy(1.0)), 1.0);
        assert_eq!(from_one_to_the_next(1.0, 0.5, 1, None), 1.0);
        assert_eq!(from_one_to_the_next(1.0, 9.0, 3, None), 3.0);
    }

    #[test]
    fn small_runs_are_timed_on_every_cpu_device() {
        let mut config = config();
        (config.data.width, config.data.height) = (16, 16);
        (config.model.dim, config.model.num_heads, config.model.feed_forward_dim) = (16, 2, 24);
        (config.stage1.batch_size, config.stage2.batch_size) = (2, 2);
        config.clusters.grid = vec![TokenCount::Share(0.25), TokenCount::Share(0.5)];
        for device in [DeviceName::Flex, DeviceName::Ndarray] {
            let plan = plan(&Config { device, ..config.clone() }, true).expect("runs");
            for part in plan.parts {
                let seconds = part.seconds.expect("asked for");
                assert!(seconds > 0.0 && seconds < 60.0, "{device} {}: {seconds}", part.part);
            }
        }
    }
}
