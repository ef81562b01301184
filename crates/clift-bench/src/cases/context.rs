//! Options of a benchmark; sizes, device and shared inputs of its rows.

use std::cell::OnceCell;
use std::path::PathBuf;
use std::time::Instant;

use burn::module::Module;
use burn::tensor::Device;
use clift_core::BadConfig;
use clift_data::{Clip, DataConfig, SourceKind, SyntheticConfig, ViewSampler};
use clift_model::{DeviceName, ModelConfig, Network, TokenCount, Tokens, Views};
use clift_train::{ClipShape, Config, Stage1Config, TrainError, seeded_clip, seeded_model};

use crate::cases::case::BenchCase;
use crate::cases::task::BenchTask;

/// Most tokens, over all scenes of a batch, of an update whose gradient is compared with f64. At full size the f64
/// reference would take twice the memory of the timed update and several times as long.
pub const MAX_CHECKED_TOKENS: usize = 1024;

/// Cases to time and their sizes.
#[derive(Clone, Debug)]
pub struct BenchOptions {
    /// The cases, in any order; they run in the order of [`BenchCase::ALL`].
    pub cases: Vec<BenchCase>,
    /// Timed repetitions, at least 1.
    pub repeats: usize,
    /// Warm-up repetitions.
    pub warmup: usize,
    /// Whether results are compared with f64.
    pub error: bool,
    /// Stored tokens of a scene.
    pub stored_tokens: TokenCount,
    /// Tokens from which a view is rendered; `None` for all of a scene.
    pub render: Option<TokenCount>,
    /// Input of K-means: a safetensors file with the tensor `features`, `[N, D]` in f32; `None` for the encoder's tokens.
    pub features: Option<PathBuf>,
}

impl BenchOptions {
    /// One timed repetition of each case, without warm-up and f64 check, with all tokens stored.
    pub fn new(cases: Vec<BenchCase>) -> Self {
        let stored_tokens = TokenCount::Share(1.0);
        Self { cases, repeats: 1, warmup: 0, error: false, stored_tokens, render: None, features: None }
    }
}

/// Sizes, device and inputs shared by all rows.
pub struct BenchContext {
    pub config: Config,
    /// Device of the tensors, without autodiff.
    pub device: Device,
    /// Whether tensors are in the memory of this process.
    pub is_cpu: bool,
    stored_tokens: TokenCount,
    render: Option<TokenCount>,
    pub features: Option<PathBuf>,
    /// Tokens of one scene, computed once.
    lift: OnceCell<Tokens>,
}

impl BenchContext {
    /// Checks the sizes and opens the device of a config. The scenes of the config are not opened.
    pub fn new(config: &Config, options: &BenchOptions) -> Result<Self, TrainError> {
        let mut config = config.clone();
        // The rows use seeded images: the data of the config need not exist.
        let DataConfig { width, height, .. } = config.data;
        let synthetic = SyntheticConfig { width, height, ..SyntheticConfig::default() };
        (config.data.source, config.data.root, config.data.synthetic) = (SourceKind::Synthetic, None, synthetic);
        config.validate()?;
        let device = config.device.open()?;
        config.precision.check("precision", &device)?;
        let context = Self {
            device,
            is_cpu: config.device.is_cpu(),
            stored_tokens: options.stored_tokens,
            render: options.render,
            features: options.features.clone(),
            lift: OnceCell::new(),
            config,
        };
        // K-means of a file clusters the tokens of the file.
        if options.features.is_none() || options.cases.iter().any(|case| *case != BenchCase::Kmeans) {
            context.num_storage_tokens()?;
        }
        context.num_render_tokens()?;
        Ok(context)
    }

    fn with(&self, config: Config) -> Self {
        let (device, is_cpu, stored_tokens) = (self.device.clone(), self.is_cpu, self.stored_tokens);
        Self { config, device, is_cpu, stored_tokens, render: None, features: None, lift: OnceCell::new() }
    }

    /// Returns the small network of `stage1_step_tiny`: 256 tokens, 64 target patches, batch 8 for every config.
    pub fn tiny(&self) -> Self {
        let model = ModelConfig {
            dim: 128,
            num_heads: 8,
            feed_forward_dim: 341,
            num_encoder_blocks: 3,
            num_renderer_blocks: 3,
            ..ModelConfig::default()
        };
        let views = ViewSampler { min_context: 4, num_targets: 1, ..ViewSampler::default() };
        let data = DataConfig { width: 64, height: 64, views, ..DataConfig::default() };
        let stage1 = Stage1Config { batch_size: 8, accumulate: 1, ..Stage1Config::default() };
        let Config { seed, device, precision, .. } = self.config;
        self.with(Config { seed, device, precision, data, model, stage1, ..Config::default() })
    }

    /// Returns the same network on at most [`MAX_CHECKED_TOKENS`] tokens: smaller images, then fewer scenes and views.
    pub fn reduced(&self) -> Result<Self, TrainError> {
        let mut config = self.config.clone();
        let patch = config.model.patch_size;
        config.model.num_latents = config.model.num_latents.min(MAX_CHECKED_TOKENS);
        let Config { data, stage1, stage2, .. } = &mut config;
        let tokens = |data: &DataConfig| data.views.min_context * (data.width / patch) * (data.height / patch);
        while tokens(data) > MAX_CHECKED_TOKENS && data.width.max(data.height) > patch {
            (data.width, data.height) =
                ((data.width / patch).div_ceil(2) * patch, (data.height / patch).div_ceil(2) * patch);
        }
        data.views.min_context = data.views.min_context.min(MAX_CHECKED_TOKENS);
        data.views.num_targets = data.views.num_targets.min(2);
        let num_scenes = (MAX_CHECKED_TOKENS / tokens(data)).max(1);
        stage1.batch_size = stage1.batch_size.min(num_scenes);
        stage2.batch_size = stage2.batch_size.min(num_scenes);
        let mut reduced = self.with(config);
        if let TokenCount::Count(count) = self.stored_tokens {
            reduced.stored_tokens = TokenCount::Share(count as f64 / self.num_tokens()? as f64);
        }
        Ok(reduced)
    }

    pub fn num_tokens(&self) -> Result<usize, TrainError> {
        let DataConfig { width, height, views, .. } = &self.config.data;
        Ok(self.config.model.num_tokens(views.min_context, *height, *width)?)
    }

    pub fn num_storage_tokens(&self) -> Result<usize, TrainError> {
        self.stored_of(self.num_tokens()?)
    }

    pub fn num_render_tokens(&self) -> Result<usize, TrainError> {
        let all = self.num_tokens()?;
        let Some(count) = self.render else { return Ok(all) };
        count.of(all).map_err(|error| BadConfig::new("--render", count, error.to_string()).into())
    }

    pub fn stored_of(&self, num_tokens: usize) -> Result<usize, TrainError> {
        self.stored_tokens.of(num_tokens).map_err(|error| {
            let hint = if self.features.is_some() { "; --case kmeans alone uses the tokens of --features" } else { "" };
            self.bad_stored_tokens(&format!("{error}{hint}"))
        })
    }

    pub fn bad_stored_tokens(&self, fix: &str) -> TrainError {
        BadConfig::new("--stored-tokens", self.stored_tokens, fix).into()
    }

    pub fn shape(&self) -> ClipShape {
        let DataConfig { width, height, views, .. } = &self.config.data;
        ClipShape { num_context: views.min_context, num_targets: views.num_targets, size: [*height, *width] }
    }

    pub fn clip(&self, num_targets: usize) -> Clip {
        seeded_clip(ClipShape { num_targets, ..self.shape() }, self.config.seed, 0)
    }

    pub fn model(&self) -> Network {
        seeded_model(&self.config.model, self.config.seed, &self.device)
    }

    /// Returns the tokens of one scene, `[1, N, D]`, computed by the seeded encoder.
    pub fn lift(&self) -> Result<Tokens, TrainError> {
        if let Some(lift) = self.lift.get() {
            return Ok(lift.clone());
        }
        let views = Views::upload(&[&self.clip(1).context], &self.device)?;
        let lift = self.model().valid().encode(&views);
        Ok(self.lift.get_or_init(|| lift).clone())
    }

    /// Returns the device of the f64 reference: flex for a GPU, which has no reliable f64.
    pub fn reference(&self) -> Result<Device, TrainError> {
        if self.is_cpu { Ok(self.device.clone()) } else { Ok(DeviceName::Flex.open()?) }
    }

    /// Runs a task once, to the end of the device's queue, and returns the seconds.
    pub fn time(&self, task: &mut dyn BenchTask) -> Result<f64, TrainError> {
        self.sync()?;
        let started = Instant::now();
        task.run()?;
        self.sync()?;
        Ok(started.elapsed().as_secs_f64())
    }

    fn sync(&self) -> Result<(), TrainError> {
        self.device.sync().map_err(|error| TrainError::Device { reason: error.to_string() })
    }
}
