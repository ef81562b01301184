//! Largest tensor of every part of a run; refuses tensors that a device cannot hold.

use burn::tensor::Device;
use clift_model::{Grouping, Part, SceneSizes, kmeans_values, largest_tensors, max_tensor_bytes, used_adapter};

use crate::config::config::Config;
use crate::error::{TrainError, bad};
use crate::events::{RunStep, Stage};
use crate::footprint::scene_sizes::{
    VIEWS_PER_PASS, cluster_counts, kept, largest_sizes, scene_with_all_tokens, scene_with_stored_tokens,
};
use crate::stage::settings::StageSettings;

/// Bytes of an f32 value; f16 operands are smaller copies of f32 tensors.
const F32: u64 = 4;
/// Channels of the first layers of both VGG networks, at the size of the image.
const VGG_CHANNELS: u64 = 64;

/// A tensor of a run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LargestTensor {
    /// Step of the run.
    pub run_step: RunStep,
    /// Description of the tensor.
    pub what: String,
    /// Size in bytes.
    pub bytes: u64,
}

/// Returns the largest tensor of a step of a run, at the most views and tokens that can be sampled.
pub fn largest_tensor(config: &Config, run_step: RunStep) -> Result<LargestTensor, TrainError> {
    let all = tensors(config, run_step)?;
    let (what, values) = all.into_iter().max_by_key(|(_, values)| *values).expect("every step has tensors");
    Ok(LargestTensor { run_step, what, bytes: values * F32 })
}

/// Refuses a run with a tensor that the open device cannot hold.
pub fn check_tensors(config: &Config, device: &Device, run_steps: &[RunStep]) -> Result<(), TrainError> {
    let Some(limit) = max_tensor_bytes(device) else { return Ok(()) };
    let name = used_adapter().map_or_else(|| config.device.to_string(), |adapter| adapter.to_string());
    check_tensor_limit(config, (&name, limit), run_steps)
}

fn check_tensor_limit(config: &Config, (device, limit): (&str, u64), run_steps: &[RunStep]) -> Result<(), TrainError> {
    for &run_step in run_steps {
        let LargestTensor { what, bytes, .. } = largest_tensor(config, run_step)?;
        if bytes > limit {
            let (key, value, fix) = largest_fitting_setting(config, run_step, limit)?;
            let of = if run_step == RunStep::Eval { "the evaluation" } else { run_step.name() };
            let fix = format!(
                "{what} of {of} would be one tensor of {bytes} bytes, and {device} takes at most {limit} in one: {fix}"
            );
            return Err(bad(&key, value, &fix));
        }
    }
    Ok(())
}

/// Returns the key to change, its value, and the largest value that fits.
fn largest_fitting_setting(
    config: &Config,
    run_step: RunStep,
    limit: u64,
) -> Result<(String, String, String), TrainError> {
    let fits = |config: &Config| Ok::<_, TrainError>(largest_tensor(config, run_step)?.bytes <= limit);
    let mut smaller = config.clone();
    let set_views = |config: &mut Config, count: usize| {
        if run_step == RunStep::Eval {
            config.eval.num_context = count;
            return;
        }
        config.data.views.max_context = count;
        config.data.views.min_context = config.data.views.min_context.min(count);
    };
    let mut also = String::new();
    if let RunStep::Train(stage) = run_step {
        let StageSettings { batch_size, accumulate, .. } = config.stage(stage);
        let key = format!("{}.accumulate", stage.name());
        for parts in accumulate..=batch_size {
            smaller.set_accumulate(stage, parts);
            if fits(&smaller)? {
                return Ok((key, accumulate.to_string(), format!("write {parts}")));
            }
        }
        also = format!(" with {key} = {batch_size}");
    }
    let (key, now) = match run_step {
        RunStep::Eval => ("eval.num_context", config.eval.num_context),
        _ => ("data.views.max_context", config.data.views.max_context),
    };
    for count in (1..now).rev() {
        set_views(&mut smaller, count);
        if fits(&smaller)? {
            return Ok((key.into(), now.to_string(), format!("write {count}{also}, or choose smaller images")));
        }
    }
    let size = format!("{}, {}", config.data.width, config.data.height);
    Ok(("data.width, data.height".into(), size, "even one view does not fit: choose smaller images".into()))
}

/// Lists the tensors that can be the largest of a step, with their numbers of values.
fn tensors(config: &Config, run_step: RunStep) -> Result<Vec<(String, u64)>, TrainError> {
    let (eval, views) = (&config.eval, &config.data.views);
    let (num_context, num_targets) = match run_step {
        RunStep::Eval => (eval.num_context, eval.num_targets.clamp(1, VIEWS_PER_PASS)),
        _ => (views.max_context, views.num_targets),
    };
    let scene = scene_with_all_tokens(config, num_context, num_targets)?;
    let stage = if let RunStep::Train(stage) = run_step { Some(stage) } else { None };
    let num_scenes = stage.map_or(1, |stage| config.stage(stage).micro_batch_size());
    let of = |network: Part, scene: &SceneSizes| largest_tensors(&config.model, network, scene, num_scenes);
    let mut all = of(Part::Encoder, &scene);
    let supports_clusters = config.model.architecture.supports_clusters();
    let counts = match run_step {
        _ if !supports_clusters => Vec::new(),
        RunStep::Train(Stage::Stage1) => Vec::new(),
        RunStep::Train(Stage::Stage2) | RunStep::Clusters => cluster_counts(config, scene.num_tokens)?,
        // An evaluation index may have other numbers of contexts.
        RunStep::Eval => eval
            .stored_tokens
            .iter()
            .map(|count| count.of(scene.num_tokens))
            .collect::<Result<_, _>>()
            .unwrap_or_default(),
    };
    let most = counts.into_iter().max().unwrap_or(scene.num_tokens);
    if !supports_clusters {
        all.extend(of(Part::Renderer, &scene));
    } else if run_step == RunStep::Eval || run_step == RunStep::Clusters && config.clusters.grouping == Grouping::Kmeans
    {
        all.push(("the distances of K-means".into(), kmeans_values(scene.num_tokens, most)));
    }
    if matches!(run_step, RunStep::Train(Stage::Stage2) | RunStep::Eval) && supports_clusters {
        all.extend(of(Part::Condenser, &scene_with_stored_tokens(scene, most)));
        all.extend(of(Part::Renderer, &scene_with_stored_tokens(scene, most)));
    }
    if stage == Some(Stage::Stage1) {
        all.extend(of(Part::Renderer, &largest_sizes(config, Stage::Stage1)?));
        // Views share the tokens of the steps in which all are kept.
        if kept(scene, config.stage1.keep_tokens[1]) == scene {
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
    use clift_model::{MAX_SCORES, TokenCount};

    use super::*;

    /// The paper's network on six contexts of 256 x 256 and six targets, N = 6,144, T Q = 6,144.
    fn paper() -> Config {
        let mut config = Config { run_dir: "run".into(), ..Config::default() };
        (config.data.views.min_context, config.data.views.max_context, config.data.views.num_targets) = (4, 6, 6);
        (config.data.synthetic.width, config.data.synthetic.height) = (256, 256);
        config
    }

    fn largest(config: &Config, run_step: impl Into<RunStep>) -> (String, u64) {
        let LargestTensor { what, bytes, .. } = largest_tensor(config, run_step.into()).expect("valid");
        (what, bytes)
    }

    #[test]
    fn paper_batch_is_largest_with_tokens_per_view() {
        let mut config = paper();
        config.stage1.accumulate = 16;
        // 4 scenes x 6 views x 6,143 tokens x 2 x 768 values.
        let own = ("the keys and values of the renderer's tokens".into(), 4 * 6 * 6143 * 2 * 768 * 4);
        assert_eq!(largest(&config, Stage::Stage1), own);
        // With all tokens in every step views share them: 4 x 6,144 x 3 x 768 of the encoder are more.
        config.stage1.keep_tokens = [1.0, 1.0];
        let packed = 4 * 6144 * 3 * 768 * 4;
        assert_eq!(largest(&config, Stage::Stage1).1, packed);
        config.loss.perceptual_weight = 0.5;
        let maps = ("the first maps of the perceptual loss".into(), 4 * 6 * 65_536 * 64 * 4);
        assert_eq!(largest(&config, Stage::Stage1), maps);
    }

    #[test]
    fn largest_tensors_of_the_later_parts() {
        let mut config = paper();
        config.stage2.accumulate = 80;
        config.clusters.grid = vec![TokenCount::Share(0.25), TokenCount::Share(1.0)];
        // One scene: 6,144 tokens x 3 x 768 and the same of 6 x 1,024 patches; scores of 8 heads in chunks of 2^24.
        let scores = 8 * 6144 * (MAX_SCORES as u64 / (8 * 6144)) * 4;
        assert_eq!(largest(&config, Stage::Stage2).1, scores);
        // A table of 6,144^2 distances.
        assert_eq!(largest(&config, RunStep::Clusters), ("the distances of K-means".into(), 6144 * 6144 * 4));
        config.data.views.max_context = 9;
        // 9,216^2 are more than a table may have: distances to 9,216 clusters.
        assert_eq!(largest(&config, RunStep::Clusters), ("the distances of K-means".into(), 9216 * 9216 * 4));
        config.eval.num_context = 1;
        config.eval.num_targets = 100;
        // Eight views at a time: 8 x 1,024 x 3 x 768.
        assert_eq!(largest(&config, RunStep::Eval).1, 8 * 1024 * 3 * 768 * 4);
    }

    #[test]
    fn refusal_names_the_micro_batch_that_fits() {
        let config = paper();
        let limit = (1 << 31) - 4;
        let message = check_tensor_limit(&config, ("wgpu", limit), config.run_steps()).unwrap_err().to_string();
        // 64 scenes x 6 views at once; of 9 scenes it is 2.04e9 bytes, so 8 parts fit.
        let bytes = 64_u64 * 6 * 6143 * 2 * 768 * 4;
        let expected = format!(
            "`stage1.accumulate` = 1: the keys and values of the renderer's tokens of stage1 would be one tensor of \
             {bytes} bytes, and wgpu takes at most {limit} in one: write 8"
        );
        assert_eq!(message, expected);
        let mut fitting = config.clone();
        fitting.stage1.accumulate = 8;
        check_tensor_limit(&fitting, ("wgpu", limit), &[Stage::Stage1.into()]).expect("the value of the message");
        fitting.stage1.accumulate = 7;
        assert!(check_tensor_limit(&fitting, ("wgpu", limit), &[Stage::Stage1.into()]).is_err(), "and no less");
    }

    #[test]
    fn refusal_names_fewer_views_or_smaller_images() {
        let mut config = paper();
        config.stage1.accumulate = 64;
        // 6 x 5,119 x 2 x 768 values of five contexts.
        let limit = 6 * 5119 * 2 * 768 * 4;
        let message = check_tensor_limit(&config, ("wgpu", limit), &[Stage::Stage1.into()]).unwrap_err().to_string();
        assert!(message.starts_with("`data.views.max_context` = 6:"), "{message}");
        assert!(message.ends_with("write 5 with stage1.accumulate = 64, or choose smaller images"), "{message}");
        let message = check_tensor_limit(&config, ("wgpu", 1000), &[RunStep::Eval]).unwrap_err().to_string();
        assert!(message.starts_with("`data.width, data.height` = 256, 256:"), "{message}");
        check_tensors(&config, &Device::flex(), config.run_steps()).expect("memory alone is a CPU's limit");
    }
}
