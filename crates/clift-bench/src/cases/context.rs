//! Options of a benchmark; sizes, device and shared inputs of its rows.

use std::cell::OnceCell;
use std::time::Instant;

use burn::module::Module;
use burn::tensor::Device;
use clift_core::BadConfig;
use clift_data::{Clip, DataConfig, SourceKind, SyntheticConfig};
use clift_model::{DeviceName, Network, TokenCount, Tokens, Views};
use clift_train::{ClipShape, Config, TrainError, seeded_clip, seeded_model};

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
}

pub struct BenchContext {
    pub config: Config,
    /// Device of the tensors, without autodiff.
    pub device: Device,
    pub is_cpu: bool,
    pub options: BenchOptions,
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
        let context =
            Self { device, is_cpu: config.device.is_cpu(), options: options.clone(), lift: OnceCell::new(), config };
        context.num_storage_tokens()?;
        Ok(context)
    }

    /// Returns the cases of the options that the network has, in order.
    pub fn cases(&self) -> Vec<BenchCase> {
        let has_clusters = self.config.model.architecture.supports_clusters();
        let is_measured =
            |case: &BenchCase| self.options.cases.contains(case) && (has_clusters || !case.needs_clusters());
        BenchCase::ALL.iter().copied().filter(is_measured).collect()
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
        let (device, mut options) = (self.device.clone(), self.options.clone());
        if let TokenCount::Count(count) = options.stored_tokens {
            options.stored_tokens = TokenCount::Share(count as f64 / self.num_tokens()? as f64);
        }
        Ok(Self { config, device, is_cpu: self.is_cpu, options, lift: OnceCell::new() })
    }

    pub fn num_tokens(&self) -> Result<usize, TrainError> {
        let DataConfig { width, height, views, .. } = &self.config.data;
        Ok(self.config.model.num_tokens(views.min_context, *height, *width)?)
    }

    pub fn num_storage_tokens(&self) -> Result<usize, TrainError> {
        let all = self.num_tokens()?;
        self.options.stored_tokens.of(all).map_err(|error| self.bad_stored_tokens(&error.to_string()))
    }

    pub fn bad_stored_tokens(&self, fix: &str) -> TrainError {
        BadConfig::new("--stored-tokens", self.options.stored_tokens, fix).into()
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
