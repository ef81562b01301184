//! Seconds of a shallow copy of the network on this device, from which those of the whole one are counted.

use std::time::Instant;

use burn::module::Module;
use burn::optim::GradientsParams;
use burn::tensor::Tensor;
use clift_data::{ClipReader, Split, item_rng, open_dataset, step_rng, upper_median};
use clift_eval::{EvalModels, EvalResults, Lpips, Sweep, evaluate_scene, upload_cameras, upload_views};
use clift_model::{FlopConvention, ModelConfig, Parameters, Part, SceneModel, SceneSizes, TokenCount, TrainedModel};
use clift_train::{
    Config, DeviceBatch, Loss, LossScale, Shape, Stage, StageBatch, TokenSelection, TrainError, TrainState,
    TypicalStep, adamw, clip_global_norm, eval_sizes, freeze, global_norm, measures_lpips, render_loss, scene,
    seeded_batch, seeded_clip, trained_parts,
};
use cpu_time::ProcessTime;
use rand::RngExt;
use rand::seq::index::sample;

use crate::cases::context::BenchContext;
use crate::cases::options::BenchOptions;

/// Multiplications of a calibrated update: a second of a laptop.
const ENOUGH_MACS: f64 = 30e9;

/// Fewest and most repetitions that are timed, after one that is not.
const REPEATS: [usize; 2] = [3, 15];

/// Seconds of repetitions that are enough of them.
const ENOUGH_S: f64 = 0.7;

/// What a device takes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rates {
    /// Seconds of one multiplication of the network, with everything around it.
    pub per_mac: f64,
    /// Seconds of the update of one parameter: norm, clipping, `AdamW`.
    pub per_parameter: f64,
    /// Seconds of the perceptual loss of one target picture, forward and backward; 0 without one.
    pub per_picture: f64,
    /// Threads of this process that are at work during an update, on average.
    pub busy: f64,
}

/// Seconds of a piece of work, and the threads at work meanwhile.
struct Timed {
    seconds: f64,
    busy: f64,
}

impl Timed {
    /// The median of some repetitions after one that is not timed: tokens and seeds change little, other processes a lot.
    fn of(mut work: impl FnMut() -> Result<(), TrainError>) -> Result<Self, TrainError> {
        Ok(Self::passing((), |()| work())?.1)
    }

    /// The same of work that changes something, and what that is in the end.
    fn passing<T>(state: T, mut work: impl FnMut(T) -> Result<T, TrainError>) -> Result<(T, Self), TrainError> {
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
        Ok((state, Self { seconds: upper_median(&seconds), busy }))
    }
}

/// What a device takes without gradients.
#[derive(Clone, Debug, PartialEq)]
pub struct InferenceRates {
    /// Seconds of one multiplication of the encoder.
    pub encode_per_mac: f64,
    /// Seconds of one multiplication of the renderer.
    pub render_per_mac: f64,
    /// Seconds of latent K-means by number of clusters.
    pub kmeans: Vec<(usize, f64)>,
    /// Seconds of the evaluation of one scene with the networks of `timed`: clusters, pictures and their measures.
    pub measuring_s: f64,
    /// The network that was timed.
    pub timed: ModelConfig,
}

/// Multiplications of one network on a scene.
pub fn macs_of(model: &ModelConfig, network: Part, scene: &SceneSizes) -> f64 {
    model.macs(network, scene).count(FlopConvention::Macs) as f64
}

/// Multiplications of a scene's share of an update: a forward and a backward pass of twice its multiplications, which
/// is what linear layers take; recomputing is a second forward.
pub fn update_macs(config: &Config, stage: Stage, scene: &SceneSizes) -> f64 {
    let [encoder, condenser, renderer] =
        [Part::Encoder, Part::Condenser, Part::Renderer].map(|network| macs_of(&config.model, network, scene));
    let passes = if config.activation_checkpointing { 4.0 } else { 3.0 };
    if stage == Stage::Stage2 { encoder + passes * (condenser + renderer) } else { passes * (encoder + renderer) }
}

/// The config with one block of each kind, which take as long as any other.
fn shallow(config: &Config) -> Config {
    let mut config = config.clone();
    let model = &mut config.model;
    // Encoder and renderer keep their proportion as far as whole blocks can.
    let [encoder, renderer] = [model.num_encoder_blocks, model.num_renderer_blocks];
    let fewest = encoder.min(renderer);
    model.num_encoder_blocks = (encoder + fewest / 2) / fewest;
    model.num_renderer_blocks = (renderer + fewest / 2) / fewest;
    model.condenser.num_blocks = 1;
    config
}

fn context(config: &Config, num_context: usize) -> Result<BenchContext, TrainError> {
    let mut config = config.clone();
    (config.data.views.min_context, config.data.views.max_context) = (num_context, num_context);
    // Clusters and counts are this module's own.
    config.clusters.grid = vec![TokenCount::Share(1.0)];
    let options = BenchOptions {
        work: Vec::new(),
        repeats: 1,
        warmup: 0,
        error: false,
        storage: TokenCount::Share(1.0),
        render: None,
        features: None,
    };
    BenchContext::new(&config, &options)
}

/// Times an update of a shallow network at the middle of a stage's sizes.
pub fn update_rates(config: &Config, stage: Stage, middle: &TypicalStep) -> Result<Rates, TrainError> {
    let shallow = shallow(config);
    let context = context(&shallow, middle.num_context)?;
    let macs_of_scene = update_macs(&shallow, stage, &middle.scene);
    let num_scenes = ((ENOUGH_MACS / macs_of_scene) as usize).clamp(1, middle.num_scenes);
    let batch = drawn(&context, stage, middle, num_scenes)?;
    let optimizer = if stage == Stage::Stage2 { &config.stage2.optimizer } else { &config.stage1.optimizer };
    let learner = TrainState {
        model: freeze(stage, context.model()),
        optimizer: adamw(optimizer),
        device: context.device.clone().autodiff(),
        // The network of a perceptual term is not counted.
        loss: Loss::default(),
        activation_checkpointing: config.activation_checkpointing,
        loss_scale: LossScale::of(config.precision),
    };
    let rate = optimizer.learning_rate;
    let (mut learner, step) = Timed::passing(learner, |learner| {
        let (learner, _) = learner.step(&batch, 1, rate.into(), optimizer.max_grad_norm)?;
        context.sync()?;
        Ok(learner)
    })?;
    let shown = DeviceBatch::upload(&batch, &learner.device)?;
    let mut optimizer_s = f64::INFINITY;
    for _ in 0..REPEATS[0] {
        let loss = render_loss(&learner.model, &shown, &batch.tokens, &learner.loss)?.total;
        let grads = GradientsParams::from_grads(loss.backward(), &learner.model);
        context.sync()?;
        let started = Instant::now();
        let norm = global_norm(&learner.model, &grads);
        let grads = clip_global_norm(&learner.model, grads, norm, optimizer.max_grad_norm);
        learner.model = learner.optimizer.step(rate, learner.model, grads);
        context.sync()?;
        optimizer_s = optimizer_s.min(started.elapsed().as_secs_f64());
    }
    let macs = num_scenes as f64 * macs_of_scene;
    let parameters = Parameters::of(&shallow.model).of_parts(trained_parts(stage)) as f64;
    Ok(Rates {
        per_mac: (step.seconds - optimizer_s).max(0.0) / macs,
        per_parameter: optimizer_s / parameters,
        per_picture: perceptual_s(config, &context)?,
        busy: step.busy,
    })
}

/// Seconds of the perceptual term of one picture and of its gradient.
fn perceptual_s(config: &Config, context: &BenchContext) -> Result<f64, TrainError> {
    if config.loss.weights()?.is_none() {
        return Ok(0.0);
    }
    let loss = Loss::load(&config.loss, &context.device)?;
    let size = [1, 1, config.data.height, config.data.width, 3];
    let picture = |value: f64| Tensor::<5>::full(size, value, &context.device.clone().autodiff());
    let timed = Timed::of(|| {
        let rendering = picture(0.3).require_grad();
        let grads = loss.of(rendering.clone(), picture(0.6)).total.backward();
        let grad = rendering.grad(&grads).ok_or_else(|| TrainError::Tensor { reason: "no gradient".into() })?;
        read(grad.flatten(0, 2))
    })?;
    Ok(timed.seconds)
}

/// A batch of made-up scenes with the middle's numbers of tokens.
fn drawn(
    context: &BenchContext,
    stage: Stage,
    middle: &TypicalStep,
    num_scenes: usize,
) -> Result<StageBatch, TrainError> {
    let (num_tokens, kept) = (context.num_tokens()?, middle.scene.num_render_tokens);
    let stored = (stage == Stage::Stage2).then_some(kept);
    let mut batch = seeded_batch(context.shape(), num_scenes, num_tokens, stored, context.seed())?;
    if stage != Stage::Stage2 && kept < num_tokens {
        let subsets = batch.clips.iter().enumerate().map(|(slot, clip)| {
            let mut rng = item_rng(context.seed(), 0, slot as u32, 0, "plan tokens");
            let subset = |_| sample(&mut rng, num_tokens, kept).into_iter().map(|token| token as u32).collect();
            (0..clip.target.num_views()).map(subset).collect()
        });
        batch.tokens = TokenSelection::Subsets(subsets.collect());
    }
    Ok(batch)
}

/// Times encoding, drawing, clustering and measuring one scene.
pub fn inference_rates(config: &Config, sizes: &InferenceTimed) -> Result<InferenceRates, TrainError> {
    let InferenceTimed { num_context, num_targets, counts, is_measured } = *sizes;
    let shallow = shallow(config);
    let context = context(&shallow, num_context)?;
    let model = context.model().valid();
    let shape = Shape { num_context, num_targets, ..context.shape() };
    let clip = seeded_clip(shape, context.seed(), 0);
    let views = upload_views(&[&clip.context], &context.device)?;
    let cameras = upload_cameras(&[&clip.target], &context.device)?;
    let scene = scene(config, num_context, num_targets)?;
    let [encode_macs, render_macs] =
        [Part::Encoder, Part::Renderer].map(|network| macs_of(&shallow.model, network, &scene));
    let encode_s = Timed::of(|| read(model.encode(&views)))?.seconds;
    let lift = model.encode(&views);
    let render_s = Timed::of(|| read(model.renderer.forward(lift.clone(), &cameras).flatten(0, 2)))?.seconds;
    let mut kmeans = Vec::new();
    let mut measuring_s = 0.0;
    if is_measured {
        let stage2 = TrainedModel::snapshot(&model, &shallow.model, true);
        let models = EvalModels { stage2: Some(stage2.clone()), ..EvalModels::new(stage2) };
        let lpips = config.eval.lpips_path().filter(|_| measures_lpips(config));
        let lpips = lpips.map(|path| Lpips::load(path, &context.device)).transpose()?;
        let sweep = Sweep { model: shallow.model.clone(), lpips, ..eval_sizes(config) };
        // One for all: after the first time no setting draws the view that warms it up.
        let mut measured = EvalResults::default();
        measuring_s =
            Timed::of(|| Ok(evaluate_scene(&models, &clip, &sweep, false, &mut measured).map(|_| ())?))?.seconds;
    } else {
        for &count in counts {
            // One seed takes a few iterations more, another fewer.
            let seeds: Vec<u64> = (0..3).map(|seed| step_rng(context.seed(), seed, "plan clusters").random()).collect();
            let timed = Timed::of(|| {
                for &seed in &seeds {
                    config.clusters.kmeans.fit(lift.clone(), count, &[seed])?;
                }
                Ok(())
            })?;
            kmeans.push((count, timed.seconds / seeds.len() as f64));
        }
    }
    let [encode_per_mac, render_per_mac] = [encode_s / encode_macs, render_s / render_macs];
    Ok(InferenceRates { encode_per_mac, render_per_mac, kmeans, measuring_s, timed: shallow.model })
}

/// What is timed without gradients.
#[derive(Clone, Copy, Debug)]
pub struct InferenceTimed<'a> {
    /// Context views.
    pub num_context: usize,
    /// Target views that are drawn at once.
    pub num_targets: usize,
    /// Counts of clusters.
    pub counts: &'a [usize],
    /// Whether a whole evaluation of the scene is timed, and not its clusters alone.
    pub is_measured: bool,
}

/// Seconds that one thread takes to read a view of a training scene; `None` where the data is not there.
pub fn loading_s(config: &Config) -> Option<f64> {
    let source = open_dataset(&config.data, Split::Train).ok()?.source;
    let reader = ClipReader { source, options: config.data.clip_options() };
    let views = &config.data.views;
    let num_scenes = reader.source.num_scenes().min(6);
    let mut total_s = 0.0;
    for scene in 0..num_scenes {
        let mut rng = item_rng(config.seed, 0, scene as u32, 0, "plan views");
        let source = reader.source.as_ref();
        let drawn = views.sample(source, scene, views.warm_up_steps, views.max_context, &mut rng).ok()?;
        let num_views = drawn.context.len() + drawn.target.len();
        let mut least_s = f64::INFINITY;
        for _ in 0..2 {
            let started = Instant::now();
            reader.read(scene, &drawn).ok()?;
            least_s = least_s.min(started.elapsed().as_secs_f64());
        }
        total_s += least_s / num_views as f64;
    }
    (num_scenes > 0).then(|| total_s / num_scenes as f64)
}

/// Waits for a value of a result.
fn read(tensor: Tensor<3>) -> Result<(), TrainError> {
    let value = tensor.slice([0..1, 0..1, 0..1]).into_data();
    if value.num_elements() == 1 { Ok(()) } else { Err(TrainError::Tensor { reason: "it is empty".into() }) }
}
