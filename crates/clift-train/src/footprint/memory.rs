//! Peak memory of every part of a run, and a warning where the device has less.

use clift_eval::{EvalConfig, Method};
use clift_model::{
    DeviceName, InferenceSizes, LPIPS_MIN_SIZE_PX, Parameters, Precision, SceneSizes, Segment, UpdateSizes, VggShape,
    inference_bytes, update_bytes,
};

use crate::config::config::{Algorithm, Config};
use crate::error::TrainError;
use crate::events::{RunStep, Stage};
use crate::step::train_state::num_at_once;

/// Target views that an evaluation renders at once.
pub const VIEWS_PER_PASS: usize = 8;
/// Memory of a process besides its tensors: code, threads and buffers (docs/guide/training.md).
const PROCESS_BYTES: u64 = 20 << 20;

/// Returns the peak memory of the process during a step of a run.
pub fn peak_bytes(config: &Config, run_step: RunStep) -> Result<u64, TrainError> {
    let bytes = match run_step {
        RunStep::Train(stage) => update(config, stage)?,
        RunStep::Clusters => inference_bytes(&config.model, &clusters(config)?),
        RunStep::Eval => inference_bytes(&config.model, &evaluation(config)?),
    };
    Ok(PROCESS_BYTES + bytes as u64)
}

/// Describes the step of a run that exceeds the `available` memory the most, with a change of the config; `None` if all steps
/// fit or the available memory is unknown.
pub fn memory_warning(config: &Config, available: Option<u64>) -> Result<Option<String>, TrainError> {
    let Some(available) = available else { return Ok(None) };
    let peak = |&run_step: &RunStep| Ok::<_, TrainError>((peak_bytes(config, run_step)?, run_step));
    let peaks = config.run_steps().iter().map(peak).collect::<Result<Vec<_>, _>>()?;
    let largest = peaks.into_iter().filter(|(bytes, _)| *bytes > available).max_by_key(|(bytes, _)| *bytes);
    Ok(largest.map(|(bytes, run_step)| {
        let [bytes, available] = [bytes, available].map(|bytes| bytes as f64 / f64::from(1 << 30));
        let (name, device) = (run_step.name(), config.device);
        let has_parts = matches!(run_step, RunStep::Train(stage) if config.stage(stage).micro_batch_size() > 1);
        let more = if has_parts { format!("a larger {name}.accumulate, ") } else { String::new() };
        format!(
            "{name} needs about {bytes:.1} GiB, and {device} has {available:.1} GiB available: choose {more}fewer or \
             smaller views"
        )
    }))
}

fn update(config: &Config, stage: Stage) -> Result<f64, TrainError> {
    let settings = config.stage(stage);
    let scene = largest_scene(config, stage)?;
    let at_once = num_at_once(config.device == DeviceName::Flex, scene.num_context_patches);
    let num_scenes = settings.batch_size.min(settings.micro_batch_size() * at_once);
    let num_image_values = image_values(config);
    let vgg =
        (config.loss.perceptual_weight > 0.0).then(|| VggShape::VGG19.sizes(config.data.height, config.data.width));
    // Outputs of layers are stored before and after their ReLU, and features of the targets until the difference; a
    // convolution copies its input into another order.
    let images = config.data.views.num_targets as f64;
    let loss = vgg.map_or_else(Segment::default, |vgg| Segment {
        kept: images * (2.0 * vgg.outputs + vgg.features),
        working: images * 3.0 * vgg.widest,
        forward: images * (2.0 * vgg.outputs + 2.0 * vgg.features + 2.0 * vgg.widest),
        parameters: 0.0,
    });
    let sizes = UpdateSizes {
        trained: stage.trained(),
        num_scenes,
        is_accumulated: settings.micro_batch_size() < settings.batch_size,
        // Of GPUs with matrix instructions: without them f16 is computed, and saved, in f32.
        saves_half: match config.precision {
            Precision::F32 => false,
            Precision::Bf16 => true,
            Precision::F16 => config.device == DeviceName::Wgpu,
        },
        matrix_moments: if settings.optimizer.algorithm == Algorithm::Muon { 1 } else { 2 },
        scene,
        num_image_values,
        loss,
        loss_parameters: vgg.map_or(0.0, |vgg| vgg.parameters),
    };
    // Prefetched batches, one byte per value.
    let waiting = (config.data.num_prefetch + 1) * settings.batch_size * num_image_values;
    Ok(update_bytes(&config.model, &sizes) + waiting as f64)
}

fn clusters(config: &Config) -> Result<InferenceSizes, TrainError> {
    let parameters = Parameters::of(&config.model);
    let scene = scene(config, config.data.views.max_context, 0)?;
    Ok(InferenceSizes {
        num_parameters: parameters.total,
        num_loaded: parameters.encoder + parameters.renderer,
        num_encoder_rows: scene.num_tokens,
        num_tokens: scene.num_tokens,
        num_clusters: Some(most_clusters(config, scene.num_tokens)?),
        num_targets: 0,
        num_patches: config.model.num_patches(1, config.data.height, config.data.width)?,
        num_image_values: image_values(config),
        metric_working: 0.0,
        metric_parameters: 0.0,
    })
}

fn evaluation(config: &Config) -> Result<InferenceSizes, TrainError> {
    let Config { eval, data, .. } = config;
    let parameters = Parameters::of(&config.model);
    let supports_clusters = config.model.architecture.supports_clusters();
    let scene = scene(config, eval.num_context, 0)?;
    let counts = config.eval_stored_tokens().into_iter().map(|count| count.of(scene.num_tokens));
    let stored = counts.collect::<Result<Vec<_>, _>>()?;
    let planned = planned_eval(config);
    let num_rendered: usize = stored.iter().map(|&count| planned.token_counts(count).len()).sum();
    let measures_lpips = eval.lpips_path().is_some() && data.width.min(data.height) >= LPIPS_MIN_SIZE_PX;
    let vgg = measures_lpips.then(|| VggShape::VGG16.sizes(data.height, data.width));
    Ok(InferenceSizes {
        // Each of two stages has a renderer.
        num_parameters: parameters.total + if supports_clusters { parameters.renderer } else { 0 },
        num_loaded: parameters.condenser + parameters.renderer,
        num_encoder_rows: scene.num_encoder_rows(&config.model),
        num_tokens: scene.num_tokens,
        num_clusters: stored.iter().max().copied().filter(|_| supports_clusters),
        num_targets: eval.num_targets.min(VIEWS_PER_PASS),
        num_patches: config.model.num_patches(1, data.height, data.width)?,
        // Images of every count and method are kept until the metrics of the scene are computed.
        num_image_values: eval.num_targets * (num_rendered + 3) * data.width * data.height * 3,
        // Features of the images, their unit vectors, and input and output of a layer; or the file of weights while it is
        // read.
        metric_working: vgg.map_or(0.0, |vgg| {
            let rendering = (eval.num_targets + 2) as f64 * vgg.features + 3.0 * vgg.widest;
            rendering.max(vgg.parameters)
        }),
        metric_parameters: vgg.map_or(0.0, |vgg| vgg.parameters),
    })
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

/// Returns the sizes of a scene whose target views are rendered from all its tokens.
pub fn scene(config: &Config, num_context: usize, num_targets: usize) -> Result<SceneSizes, TrainError> {
    Ok(SceneSizes::of(&config.model, num_context, num_targets, [config.data.height, config.data.width])?)
}

pub fn largest_scene(config: &Config, stage: Stage) -> Result<SceneSizes, TrainError> {
    let views = &config.data.views;
    let scene = scene(config, views.max_context, views.num_targets)?;
    if stage == Stage::Stage2 {
        let most = most_clusters(config, scene.num_tokens)?;
        return Ok(SceneSizes { num_storage_tokens: Some(most), num_render_tokens: most, ..scene });
    }
    let [low, high] = config.stage1.keep_tokens;
    let kept = ((scene.num_tokens as f64 * high) as usize).max(1);
    // Views share the tokens only if all are kept; with one token less, every view has its own subset.
    let is_per_view = low < 1.0;
    let num_render_tokens = if is_per_view { kept.min((scene.num_tokens - 1).max(1)) } else { kept };
    Ok(SceneSizes { num_render_tokens, is_per_view, ..scene })
}

pub fn most_clusters(config: &Config, num_tokens: usize) -> Result<usize, TrainError> {
    let counts = config.clusters.grid.iter().map(|count| count.of(num_tokens));
    Ok(counts.collect::<Result<Vec<_>, _>>()?.into_iter().max().unwrap_or(num_tokens))
}

/// Returns the number of values of all images of the largest training scene.
fn image_values(config: &Config) -> usize {
    let views = &config.data.views;
    (views.max_context + views.num_targets) * config.data.height * config.data.width * 3
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn warning_names_the_largest_step() {
        let mut config = Config { run_dir: "run".into(), ..Config::default() };
        (config.data.synthetic.width, config.data.synthetic.height) = (256, 256);
        let most =
            config.run_steps().iter().map(|step| peak_bytes(&config, *step).expect("valid")).max().expect("steps");
        assert_eq!(memory_warning(&config, None).expect("valid"), None);
        assert_eq!(memory_warning(&config, Some(most)).expect("valid"), None);
        let text = memory_warning(&config, Some(most - 1)).expect("valid").expect("one step is too large");
        assert!(text.starts_with("stage") && text.contains("a larger stage"), "{text}");
    }
}
