//! Peak memory of every part of a run, and a warning where the device has less.

use clift_model::{InferenceSizes, Parameters, Segment, UpdateSizes, VggShape, inference_bytes, update_bytes};

use crate::config::config::Config;
use crate::error::TrainError;
use crate::events::{RunStep, Stage};
use crate::footprint::scene_sizes::{
    VIEWS_PER_PASS, cluster_counts, image_values, largest_sizes, measures_lpips, num_patches, num_tokens, planned_eval,
    scene_with_all_tokens,
};

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

/// Describes the step of a run that exceeds the `available` memory the most, with a change of the config that fits;
/// `None` if all steps fit or the available memory is unknown.
pub fn memory_warning(config: &Config, available: Option<u64>) -> Result<Option<String>, TrainError> {
    let Some(available) = available else { return Ok(None) };
    let mut largest = None;
    for &run_step in config.run_steps() {
        let bytes = peak_bytes(config, run_step)?;
        if bytes > available && largest.is_none_or(|(_, most)| bytes >= most) {
            largest = Some((run_step, bytes));
        }
    }
    let Some((run_step, bytes)) = largest else { return Ok(None) };
    let name = run_step.name();
    let gib = |bytes: u64| bytes as f64 / f64::from(1 << 30);
    let device = config.device;
    let needs =
        format!("{name} needs about {:.1} GiB, and {device} has {:.1} GiB available", gib(bytes), gib(available));
    let RunStep::Train(stage) = run_step else {
        return Ok(Some(format!("{needs}: fewer context views, or smaller ones, would fit")));
    };
    let was_on = config.activation_checkpointing;
    for activation_checkpointing in [config.activation_checkpointing, true] {
        let mut config = Config { activation_checkpointing, ..config.clone() };
        let also = if activation_checkpointing && !was_on { "activation_checkpointing = true and " } else { "" };
        for parts in 1..=config.stage(stage).batch_size {
            config.set_accumulate(stage, parts);
            if peak_bytes(&config, run_step)? <= available {
                return Ok(Some(format!("{needs}: {also}{name}.accumulate = {parts} would fit")));
            }
        }
    }
    Ok(Some(format!("{needs}: even one scene at a time with activation_checkpointing = true does not fit")))
}

fn update(config: &Config, stage: Stage) -> Result<f64, TrainError> {
    let settings = config.stage(stage);
    let num_scenes = settings.micro_batch_size();
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
        is_accumulated: num_scenes < settings.batch_size,
        activation_checkpointing: config.activation_checkpointing,
        precision: config.precision,
        matrix_moments: settings.optimizer.algorithm.matrix_moments(),
        scene: largest_sizes(config, stage)?,
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
    let most = num_tokens(config, config.data.views.max_context)?;
    Ok(InferenceSizes {
        num_parameters: parameters.total,
        num_loaded: parameters.encoder + parameters.renderer,
        num_encoder_rows: most,
        num_tokens: most,
        num_clusters: cluster_counts(config, most)?.last().copied(),
        num_targets: 0,
        num_patches: num_patches(config, 1)?,
        num_image_values: image_values(config),
        metric_working: 0.0,
        metric_parameters: 0.0,
    })
}

fn evaluation(config: &Config) -> Result<InferenceSizes, TrainError> {
    let eval = &config.eval;
    let parameters = Parameters::of(&config.model);
    let all = num_tokens(config, eval.num_context)?;
    let stored = config.eval_stored_tokens().iter().map(|count| count.of(all)).collect::<Result<Vec<_>, _>>()?;
    let supports_clusters = config.model.architecture.supports_clusters();
    let second_renderer = if supports_clusters { parameters.renderer } else { 0 };
    let scene = scene_with_all_tokens(config, eval.num_context, 0)?;
    let planned = planned_eval(config);
    let num_rendered: usize = stored.iter().map(|&count| planned.token_counts(count).len()).sum();
    let vgg = measures_lpips(config).then(|| VggShape::VGG16.sizes(config.data.height, config.data.width));
    Ok(InferenceSizes {
        // Each of two stages has a renderer.
        num_parameters: parameters.total + second_renderer,
        num_loaded: parameters.condenser + parameters.renderer,
        num_encoder_rows: scene.num_encoder_rows(&config.model),
        num_tokens: all,
        num_clusters: stored.iter().max().copied().filter(|_| supports_clusters),
        num_targets: eval.num_targets.min(VIEWS_PER_PASS),
        num_patches: num_patches(config, 1)?,
        // Images of every count and method are kept until the metrics of the scene are computed.
        num_image_values: eval.num_targets * (num_rendered + 3) * config.data.width * config.data.height * 3,
        // Features of the images, their unit vectors, and input and output of a layer; or the file of weights while it is
        // read.
        metric_working: vgg.map_or(0.0, |vgg| {
            let rendering = (eval.num_targets + 2) as f64 * vgg.features + 3.0 * vgg.widest;
            rendering.max(vgg.parameters)
        }),
        metric_parameters: vgg.map_or(0.0, |vgg| vgg.parameters),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn warning_names_the_smallest_change_that_fits() {
        let mut config = Config { run_dir: "run".into(), ..Config::default() };
        (config.data.synthetic.width, config.data.synthetic.height) = (256, 256);
        config.data.views.max_context = 4;
        let peak = |config: &Config, stage: Stage| peak_bytes(config, stage.into()).expect("valid");
        let warning = |available: u64| memory_warning(&config, Some(available)).expect("valid");
        assert_eq!(warning(u64::MAX), None);
        assert_eq!(memory_warning(&config, None).expect("valid"), None);
        let most = peak(&config, Stage::Stage1).max(peak(&config, Stage::Stage2));
        let text = warning(most - 1).expect("one part is too large");
        assert!(text.contains(".accumulate = 2 would fit"), "{text}");
        // Less than stage 2, the largest, takes scene by scene.
        let mut one_by_one = config.clone();
        one_by_one.stage2.accumulate = config.stage2.batch_size;
        let text = warning(peak(&one_by_one, Stage::Stage2) - 1).expect("too large");
        assert!(text.contains("activation_checkpointing = true and stage"), "{text}");
        let text = warning(1 << 20).expect("too large");
        assert!(text.ends_with("even one scene at a time with activation_checkpointing = true does not fit"), "{text}");
    }
}
