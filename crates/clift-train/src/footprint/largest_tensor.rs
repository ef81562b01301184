//! Largest tensor of every step of a run; refuses tensors that a device cannot hold.

use burn::tensor::Device;
use clift_model::{Grouping, Part, SceneSizes, kmeans_values, largest_tensors, max_tensor_bytes, used_adapter};

use crate::config::config::Config;
use crate::error::{TrainError, bad};
use crate::events::{RunStep, Stage};
use crate::footprint::memory::{VIEWS_PER_PASS, largest_scene, most_clusters, scene};
use crate::stage::settings::StageSettings;

/// Bytes of an f32 value; f16 operands are smaller copies of f32 tensors.
const F32: u64 = 4;
/// Channels of the first layers of both VGG networks, at the size of the image.
const VGG_CHANNELS: u64 = 64;

/// Returns the largest tensor of a step of a run, at the most views and tokens that can be sampled, and its bytes.
pub fn largest_tensor(config: &Config, run_step: RunStep) -> Result<(String, u64), TrainError> {
    let all = tensors(config, run_step)?;
    let (what, values) = all.into_iter().max_by_key(|(_, values)| *values).expect("every step has tensors");
    Ok((what, values * F32))
}

/// Refuses a run with a tensor that the open device cannot hold.
pub fn check_tensors(config: &Config, device: &Device, run_steps: &[RunStep]) -> Result<(), TrainError> {
    let Some(limit) = max_tensor_bytes(device) else { return Ok(()) };
    let name = used_adapter().map_or_else(|| config.device.to_string(), |adapter| adapter.to_string());
    check_limit(config, (&name, limit), run_steps)
}

fn check_limit(config: &Config, (device, limit): (&str, u64), run_steps: &[RunStep]) -> Result<(), TrainError> {
    for &run_step in run_steps {
        let (what, bytes) = largest_tensor(config, run_step)?;
        if bytes > limit {
            let (key, value, fix) = fitting(config, run_step, limit)?;
            let of = if run_step == RunStep::Eval { "the evaluation" } else { run_step.name() };
            let fix = format!(
                "{what} of {of} would be one tensor of {bytes} bytes, and {device} takes at most {limit} in one: {fix}"
            );
            return Err(bad(&key, value, &fix));
        }
    }
    Ok(())
}

/// Returns the key to change, its value, and the number of micro-batches that fits, if one does.
fn fitting(config: &Config, run_step: RunStep, limit: u64) -> Result<(String, usize, String), TrainError> {
    let fewer = "write fewer views, or choose smaller images";
    if let RunStep::Train(stage) = run_step {
        let StageSettings { batch_size, accumulate, .. } = config.stage(stage);
        let key = format!("{}.accumulate", stage.name());
        let mut smaller = config.clone();
        for parts in accumulate..=batch_size {
            smaller.set_accumulate(stage, parts);
            if largest_tensor(&smaller, run_step)?.1 <= limit {
                return Ok((key, accumulate, format!("write {parts}")));
            }
        }
        let fix = format!("{fewer}, also with {key} = {batch_size}");
        return Ok(("data.views.max_context".into(), config.data.views.max_context, fix));
    }
    Ok(match run_step {
        RunStep::Eval => ("eval.num_context".into(), config.eval.num_context, fewer.into()),
        _ => ("data.views.max_context".into(), config.data.views.max_context, fewer.into()),
    })
}

/// Lists the tensors that can be the largest of a step, with their numbers of values.
fn tensors(config: &Config, run_step: RunStep) -> Result<Vec<(String, u64)>, TrainError> {
    let (eval, views) = (&config.eval, &config.data.views);
    let (num_context, num_targets) = match run_step {
        RunStep::Eval => (eval.num_context, eval.num_targets.clamp(1, VIEWS_PER_PASS)),
        _ => (views.max_context, views.num_targets),
    };
    let scene = scene(config, num_context, num_targets)?;
    let stage = if let RunStep::Train(stage) = run_step { Some(stage) } else { None };
    let num_scenes = stage.map_or(1, |stage| config.stage(stage).micro_batch_size());
    let of = |network: Part, scene: &SceneSizes| largest_tensors(&config.model, network, scene, num_scenes);
    let mut all = of(Part::Encoder, &scene);
    let supports_clusters = config.model.architecture.supports_clusters();
    let most = match run_step {
        _ if !supports_clusters => scene.num_tokens,
        RunStep::Train(Stage::Stage1) => scene.num_tokens,
        RunStep::Train(Stage::Stage2) | RunStep::Clusters => most_clusters(config, scene.num_tokens)?,
        // An evaluation index may have other numbers of contexts.
        RunStep::Eval => {
            let counts = eval.stored_tokens.iter().filter_map(|count| count.of(scene.num_tokens).ok());
            counts.max().unwrap_or(scene.num_tokens)
        }
    };
    let stored = SceneSizes { num_storage_tokens: Some(most), num_render_tokens: most, ..scene };
    if !supports_clusters {
        all.extend(of(Part::Renderer, &scene));
    } else if run_step == RunStep::Eval || run_step == RunStep::Clusters && config.clusters.grouping == Grouping::Kmeans
    {
        all.push(("the distances of K-means".into(), kmeans_values(scene.num_tokens, most)));
    }
    if matches!(run_step, RunStep::Train(Stage::Stage2) | RunStep::Eval) && supports_clusters {
        all.extend(of(Part::Condenser, &stored));
        all.extend(of(Part::Renderer, &stored));
    }
    if stage == Some(Stage::Stage1) {
        all.extend(of(Part::Renderer, &largest_scene(config, Stage::Stage1)?));
        // Views share the tokens of the steps in which all are kept.
        if config.stage1.keep_tokens[1] == 1.0 {
            all.extend(of(Part::Renderer, &scene));
        }
    }
    let first_maps = (num_scenes * num_targets * config.data.width * config.data.height) as u64 * VGG_CHANNELS;
    if stage.is_some() && config.loss.perceptual_weight > 0.0 {
        all.push(("the first maps of the perceptual loss".into(), first_maps));
    }
    if run_step == RunStep::Eval && eval.lpips_path().is_some() {
        all.push(("the first maps of LPIPS".into(), first_maps));
    }
    Ok(all)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The paper's network on six contexts of 256 x 256 and six targets, N = 6,144, T Q = 6,144.
    #[test]
    fn refusal_names_the_tensor_and_the_micro_batch_that_fits() {
        let mut config = Config { run_dir: "run".into(), ..Config::default() };
        (config.data.views.min_context, config.data.views.max_context, config.data.views.num_targets) = (4, 6, 6);
        (config.data.synthetic.width, config.data.synthetic.height) = (256, 256);
        let refusal = |config: &Config, limit, run_step: RunStep| {
            check_limit(config, ("wgpu", limit), &[run_step]).map_err(|error| error.to_string())
        };
        let stage1 = RunStep::Train(Stage::Stage1);
        // 64 scenes x 6 views x 6,143 tokens x 2 x 768 values at once; of 8 scenes it is 1.8e9 bytes.
        let (bytes, limit) = (64_u64 * 6 * 6143 * 2 * 768 * 4, (1 << 31) - 4);
        let expected = format!(
            "`stage1.accumulate` = 1: the keys and values of the renderer's tokens of stage1 would be one tensor of \
             {bytes} bytes, and wgpu takes at most {limit} in one: write 8"
        );
        assert_eq!(refusal(&config, limit, stage1), Err(expected));
        config.stage1.accumulate = 8;
        assert_eq!(refusal(&config, limit, stage1), Ok(()));
        config.stage1.accumulate = 7;
        assert!(refusal(&config, limit, stage1).is_err(), "and no less");
        let message = refusal(&config, 1000, RunStep::Eval).unwrap_err();
        assert!(message.starts_with("`eval.num_context` = 4:") && message.contains("write fewer views"), "{message}");
        // A table of 6,144^2 distances.
        let distances = ("the distances of K-means".to_owned(), 6144 * 6144 * 4);
        assert_eq!(largest_tensor(&config, RunStep::Clusters).expect("valid"), distances);
        (config.loss.perceptual_weight, config.stage1.accumulate) = (0.5, 16);
        config.stage1.keep_tokens = [1.0, 1.0];
        let maps = ("the first maps of the perceptual loss".to_owned(), 4 * 6 * 65_536 * 64 * 4);
        assert_eq!(largest_tensor(&config, stage1).expect("valid"), maps);
    }
}
