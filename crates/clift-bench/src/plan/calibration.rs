//! Times a shallow copy of the network on this device, from which the seconds of the whole network are estimated.

use std::time::Instant;

use burn::module::Module;
use burn::optim::GradientsParams;
use burn::tensor::Tensor;
use clift_core::{item_rng, median, step_rng};
use clift_data::{ClipReader, Split, open_dataset};
use clift_eval::{EvalModels, EvalResults, Lpips, Perceptual, Sweep, evaluate_scene};
use clift_model::{
    Cameras, FlopConvention, ModelConfig, Parameters, Part, SceneSizes, TokenCount, TrainedModel, Views,
};
use clift_train::{
    BatchTokens, ClipShape, Config, DeviceBatch, Loss, Stage, StageBatch, TrainError, TypicalStep, clip_global_norm,
    eval_sizes, global_norm, measures_lpips, render_loss, scene_with_all_tokens, seeded_batch, seeded_clip,
};
use cpu_time::ProcessTime;
use rand::RngExt;
use rand::seq::index::sample;

use crate::cases::context::{BenchContext, BenchOptions};
use crate::cases::step::train_state;

/// Multiply-accumulates of a calibrated update: about a second on a laptop.
const ENOUGH_MACS: f64 = 30e9;

/// Fewest and most timed repetitions, after one warm-up.
const REPEATS: [usize; 2] = [3, 15];

/// Seconds after which repetitions end.
const ENOUGH_S: f64 = 0.7;

/// Measured cost of an update.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rates {
    /// Seconds per multiply-accumulate of the network, including all other operations.
    pub per_mac: f64,
    /// Seconds to update one parameter: norm, clipping, `AdamW`.
    pub per_parameter: f64,
    /// Seconds of the perceptual loss of one target image, forward and backward; 0 without this loss.
    pub per_image: f64,
    /// Mean number of busy threads of this process during an update.
    pub busy: f64,
}

/// Median seconds of a computation and its mean number of busy threads.
struct Timed {
    seconds: f64,
    busy: f64,
}

impl Timed {
    /// Times repetitions after one warm-up. The median is robust against other processes.
    fn of(mut work: impl FnMut() -> Result<(), TrainError>) -> Result<Self, TrainError> {
        Ok(Self::with_state((), |()| work())?.1)
    }

    /// Times a computation that changes `state`, and returns the final state.
    fn with_state<T>(state: T, mut work: impl FnMut(T) -> Result<T, TrainError>) -> Result<(T, Self), TrainError> {
        let mut state = work(state)?;
        let [fewest, most] = REPEATS;
        let mut seconds = Vec::new();
        let (cpu, begun) = (ProcessTime::now(), Instant::now());
        while seconds.len() < fewest || (seconds.len() < most && begun.elapsed().as_secs_f64() < ENOUGH_S) {
            let started = Instant::now();
            state = work(state)?;
            seconds.push(started.elapsed().as_secs_f64());
        }
        let busy = cpu.elapsed().as_secs_f64() / begun.elapsed().as_secs_f64();
        Ok((state, Self { seconds: median(&seconds), busy }))
    }
}

/// Measured cost without gradients.
#[derive(Clone, Debug, PartialEq)]
pub struct InferenceRates {
    /// Seconds per multiply-accumulate of the encoder.
    pub encode_per_mac: f64,
    /// Seconds per multiply-accumulate of the renderer.
    pub render_per_mac: f64,
    /// Seconds of latent K-means per number of clusters.
    pub kmeans: Vec<(usize, f64)>,
    /// Seconds to evaluate one scene with the networks of `timed`: clusters, images and metrics.
    pub evaluation_s: f64,
    pub timed: ModelConfig,
}

pub fn part_macs(model: &ModelConfig, network: Part, scene: &SceneSizes) -> f64 {
    model.macs(network, scene).count(FlopConvention::Macs) as f64
}

/// Returns the multiply-accumulates of one scene of an update: a backward pass counts as two forward passes, as for linear
/// layers, and activation checkpointing adds a forward pass.
pub fn update_macs(config: &Config, stage: Stage, scene: &SceneSizes) -> f64 {
    let [encoder, condenser, renderer] =
        [Part::Encoder, Part::Condenser, Part::Renderer].map(|network| part_macs(&config.model, network, scene));
    let passes = if config.activation_checkpointing { 4.0 } else { 3.0 };
    if stage == Stage::Stage2 { encoder + passes * (condenser + renderer) } else { passes * (encoder + renderer) }
}

/// Returns the config with the fewest blocks that keep the proportion of encoder and renderer.
fn shallow(config: &Config) -> Config {
    let mut config = config.clone();
    let model = &mut config.model;
    let [encoder, renderer] = [model.num_encoder_blocks, model.num_renderer_blocks];
    let fewest = encoder.min(renderer);
    model.num_encoder_blocks = (encoder + fewest / 2) / fewest;
    model.num_renderer_blocks = (renderer + fewest / 2) / fewest;
    model.condenser.num_blocks = model.condenser.num_blocks.min(1);
    config
}

fn context(config: &Config, num_context: usize) -> Result<BenchContext, TrainError> {
    let mut config = config.clone();
    (config.data.views.min_context, config.data.views.max_context) = (num_context, num_context);
    config.clusters.grid = vec![TokenCount::Share(1.0)];
    BenchContext::new(&config, &BenchOptions::new(Vec::new()))
}

/// Times an update of a shallow network at the typical sizes of a stage.
pub fn update_rates(config: &Config, stage: Stage, typical: &TypicalStep) -> Result<Rates, TrainError> {
    let shallow = shallow(config);
    let context = context(&shallow, typical.num_context)?;
    let macs_of_scene = update_macs(&shallow, stage, &typical.scene);
    let num_scenes = ((ENOUGH_MACS / macs_of_scene) as usize).clamp(1, typical.num_scenes);
    let batch = calibration_batch(&context, stage, typical, num_scenes)?;
    let optimizer = config.stage(stage).optimizer;
    let rate = optimizer.learning_rate;
    // The perceptual term is timed on its own.
    let (mut state, step) = Timed::with_state(train_state(&context, stage), |state| {
        let (state, _) = state.step(&batch, 1, rate.into(), optimizer.max_grad_norm)?;
        context.sync()?;
        Ok(state)
    })?;
    let device_batch = DeviceBatch::upload(&batch.clips, &state.device)?;
    let mut optimizer_s = f64::INFINITY;
    for _ in 0..REPEATS[0] {
        let loss = render_loss(&state.model, &device_batch, &batch.tokens, &state.loss)?.total;
        let grads = GradientsParams::from_grads(loss.backward(), &state.model);
        context.sync()?;
        let started = Instant::now();
        let norm = global_norm(&state.model, &grads);
        let grads = clip_global_norm(&state.model, grads, norm, optimizer.max_grad_norm);
        state.model = state.optimizer.step(rate, state.model, grads);
        context.sync()?;
        optimizer_s = optimizer_s.min(started.elapsed().as_secs_f64());
    }
    let macs = num_scenes as f64 * macs_of_scene;
    let parameters = Parameters::of(&shallow.model).of_parts(stage.trained()) as f64;
    Ok(Rates {
        per_mac: (step.seconds - optimizer_s).max(0.0) / macs,
        per_parameter: optimizer_s / parameters,
        per_image: perceptual_s(config, &context)?,
        busy: step.busy,
    })
}

/// Returns the seconds of the perceptual term of one image and of its gradient.
fn perceptual_s(config: &Config, context: &BenchContext) -> Result<f64, TrainError> {
    let weight = config.loss.perceptual_weight;
    if weight == 0.0 {
        return Ok(0.0);
    }
    // The values of the weights do not change the time: the file need not exist.
    let loss = Loss::default().with_term(weight, Perceptual::random(&context.device));
    let size = [1, 1, config.data.height, config.data.width, 3];
    let image = |value: f64| Tensor::<5>::full(size, value, &context.device.clone().autodiff());
    let timed = Timed::of(|| {
        let rendering = image(0.3).require_grad();
        let grads = loss.of(rendering.clone(), image(0.6)).total.backward();
        let grad = rendering.grad(&grads).ok_or_else(|| TrainError::Tensor { reason: "no gradient".into() })?;
        wait_for(grad.flatten(0, 2))
    })?;
    Ok(timed.seconds)
}

fn calibration_batch(
    context: &BenchContext,
    stage: Stage,
    typical: &TypicalStep,
    num_scenes: usize,
) -> Result<StageBatch, TrainError> {
    let (num_tokens, kept) = (context.num_tokens()?, typical.scene.num_render_tokens);
    let stored = (stage == Stage::Stage2).then_some(kept);
    let mut batch = seeded_batch(context.shape(), num_scenes, num_tokens, stored, context.config.seed)?;
    if stage != Stage::Stage2 && kept < num_tokens {
        let subsets = batch.clips.iter().enumerate().map(|(slot, clip)| {
            let mut rng = item_rng(context.config.seed, 0, slot as u32, 0, "plan tokens");
            let subset = |_| sample(&mut rng, num_tokens, kept).into_iter().map(|token| token as u32).collect();
            (0..clip.target.num_views()).map(subset).collect()
        });
        batch.tokens = BatchTokens::Subsets(subsets.collect());
    }
    Ok(batch)
}

/// Times encoding and rendering of one scene, and its clustering to each of `counts`; without counts, its whole evaluation.
pub fn inference_rates(
    config: &Config,
    num_context: usize,
    num_targets: usize,
    counts: Option<&[usize]>,
) -> Result<InferenceRates, TrainError> {
    let shallow = shallow(config);
    let context = context(&shallow, num_context)?;
    let model = context.model().valid();
    let shape = ClipShape { num_context, num_targets, ..context.shape() };
    let clip = seeded_clip(shape, context.config.seed, 0);
    let views = Views::upload(&[&clip.context], &context.device)?;
    let cameras = Cameras::upload(&[&clip.target], &context.device)?;
    let scene = scene_with_all_tokens(config, num_context, num_targets)?;
    let [encode_macs, render_macs] =
        [Part::Encoder, Part::Renderer].map(|network| part_macs(&shallow.model, network, &scene));
    let encode_s = Timed::of(|| wait_for(model.encode(&views).values))?.seconds;
    let lift = model.encode(&views);
    let render_s = Timed::of(|| wait_for(model.renderer.forward(lift.clone(), &cameras).flatten(0, 2)))?.seconds;
    let mut kmeans = Vec::new();
    let mut evaluation_s = 0.0;
    if let Some(counts) = counts {
        for &count in counts {
            // The number of iterations depends on the seed.
            let seeds: Vec<u64> =
                (0..3).map(|seed| step_rng(context.config.seed, seed, "plan clusters").random()).collect();
            let timed = Timed::of(|| {
                for &seed in &seeds {
                    config.clusters.kmeans.fit(lift.values.clone(), count, &[seed])?;
                }
                Ok(())
            })?;
            kmeans.push((count, timed.seconds / seeds.len() as f64));
        }
    } else {
        let has_latents = config.model.has_latents();
        let last = TrainedModel::snapshot(&model, &shallow.model, !has_latents);
        let models = EvalModels { stage2: (!has_latents).then(|| last.clone()), ..EvalModels::new(last) };
        let lpips = config.eval.lpips_path().filter(|path| measures_lpips(config) && path.is_file());
        let lpips = lpips.map(|path| Lpips::load(path, &context.device)).transpose()?;
        let sweep = Sweep { model: shallow.model.clone(), lpips, ..eval_sizes(config) };
        // Shared by the repetitions: warm-up views are rendered only for the first one.
        let mut results = EvalResults::default();
        evaluation_s =
            Timed::of(|| Ok(evaluate_scene(&models, &clip, &sweep, false, &mut results).map(|_| ())?))?.seconds;
    }
    let [encode_per_mac, render_per_mac] = [encode_s / encode_macs, render_s / render_macs];
    Ok(InferenceRates { encode_per_mac, render_per_mac, kmeans, evaluation_s, timed: shallow.model })
}

/// Returns the seconds that one thread takes to read a view of a training scene; `None` if the data cannot be read.
pub fn loading_s(config: &Config) -> Option<f64> {
    let source = open_dataset(&config.data, Split::Train, &mut |_, _| ()).ok()?.source;
    let reader = ClipReader { source, options: config.data.clip_options() };
    let views = &config.data.views;
    let num_scenes = reader.source.num_scenes().min(6);
    let mut total_s = 0.0;
    for scene in 0..num_scenes {
        let mut rng = item_rng(config.seed, 0, scene as u32, 0, "plan views");
        let source = reader.source.as_ref();
        let sampled = views.sample(source, scene, views.warm_up_steps, views.max_context, &mut rng).ok()?;
        let num_views = sampled.context.len() + sampled.target.len();
        let mut least_s = f64::INFINITY;
        for _ in 0..2 {
            let started = Instant::now();
            reader.read(scene, &sampled).ok()?;
            least_s = least_s.min(started.elapsed().as_secs_f64());
        }
        total_s += least_s / num_views as f64;
    }
    (num_scenes > 0).then(|| total_s / num_scenes as f64)
}

/// Reads one value of a result, which waits for its computation.
fn wait_for(tensor: Tensor<3>) -> Result<(), TrainError> {
    let value = tensor.slice([0..1, 0..1, 0..1]).into_data();
    if value.num_elements() == 1 { Ok(()) } else { Err(TrainError::Tensor { reason: "the tensor is empty".into() }) }
}
