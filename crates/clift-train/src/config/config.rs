//! One config file per experiment: `[data] [model] [loss] [stage1] [clusters] [stage2] [checkpoint] [eval]`.

use std::path::{Path, PathBuf};

use clift_data::DataConfig;
use clift_eval::{EvalConfig, PERCEPTUAL_COMMAND};
use clift_model::{DeviceName, Grouping, KMeans, ModelConfig, Precision, TokenCount};
use serde::{Deserialize, Serialize};

use crate::error::{TrainError, bad};

/// Most tokens of a scene: ids are kept in 16 bits.
pub const MAX_TOKENS: usize = 1 << 16;

/// A whole experiment.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Directory that receives everything the run writes.
    pub run_dir: PathBuf,
    /// Decides weights, scene order, views and token choices.
    #[serde(default)]
    pub seed: u64,
    /// Where tensors live: `flex`, `ndarray` or `wgpu`.
    #[serde(default)]
    pub device: DeviceName,
    /// Whether a training step stores only the input of every transformer block and computes the rest of the block
    /// again in the backward: the same gradients in less memory, for one more forward.
    #[serde(default)]
    pub activation_checkpointing: bool,
    /// What the operands of training's matrix products are: `f32`, or `f16` where the device has it. Weights, sums,
    /// norms, softmax, loss and optimiser are f32 in both.
    #[serde(default)]
    pub precision: Precision,
    /// Scenes and views.
    pub data: DataConfig,
    /// Sizes of the network.
    #[serde(default)]
    pub model: ModelConfig,
    /// The training loss, the same in both stages.
    #[serde(default)]
    pub loss: LossConfig,
    /// Encoder and renderer.
    pub stage1: Stage1Config,
    /// The offline cluster cache between the stages.
    #[serde(default)]
    pub clusters: ClustersConfig,
    /// Condenser, with the encoder frozen.
    pub stage2: Stage2Config,
    /// How often the state of a run is saved.
    #[serde(default)]
    pub checkpoint: CheckpointConfig,
    /// What is evaluated, during training and after it.
    #[serde(default)]
    pub eval: EvalConfig,
}

/// The training loss: mean squared error plus a weighted perceptual term (paper section 3.3).
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LossConfig {
    /// Weight of the perceptual term; the paper has 0.5. 0 trains on the mean squared error alone.
    pub perceptual_weight: f64,
    /// Weights of its network, VGG-19 as MatConvNet publishes it, converted by `scripts/tools/convert_vgg.py`.
    pub vgg_weights: Option<PathBuf>,
}

impl LossConfig {
    /// The weights to read for training, where there is a perceptual term.
    ///
    /// # Errors
    /// [`TrainError::BadConfig`] with the command that makes them, where there are none.
    pub fn weights(&self) -> Result<Option<&Path>, TrainError> {
        if self.perceptual_weight == 0.0 {
            return Ok(None);
        }
        let fix = |what: &str| {
            format!("{what}; `{PERCEPTUAL_COMMAND}` makes them, loss.perceptual_weight = 0 trains without the term")
        };
        match self.vgg_weights.as_deref() {
            None => Err(bad("loss.vgg_weights", "missing", &fix("the perceptual term needs the weights of VGG-19"))),
            Some(path) if !path.is_file() => {
                Err(bad("loss.vgg_weights", path.display(), &fix("there is no such file")))
            }
            Some(path) => Ok(Some(path)),
        }
    }
}

/// AdamW with warm-up and cosine decay.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct OptimizerConfig {
    /// Highest learning rate.
    pub learning_rate: f64,
    /// Steps until it is reached.
    pub warm_up_steps: u64,
    /// Decoupled weight decay, on every parameter as in the reference.
    pub weight_decay: f64,
    /// Gradients are scaled down to this global norm.
    pub max_grad_norm: f64,
    /// A step whose loss or gradient norm is more than this many times its median over the last 101 good steps is left
    /// out; 0 leaves out only those that are not finite.
    pub spike_factor: f64,
    /// Steps in a row that are left out before the run stops.
    pub max_bad_steps: u32,
}

impl Default for OptimizerConfig {
    fn default() -> Self {
        Self {
            learning_rate: 4e-4,
            warm_up_steps: 2500,
            weight_decay: 0.05,
            max_grad_norm: 1.0,
            // Far from what happens in good training: in `tiny.toml` no loss is above 2 times, no gradient norm above
            // 4.3 times its median.
            spike_factor: 100.0,
            max_bad_steps: 3,
        }
    }
}

/// Stage 1: encoder and renderer, on random subsets of the tokens.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Stage1Config {
    /// Optimiser updates.
    pub steps: u64,
    /// Scenes per update.
    pub batch_size: usize,
    /// Parts a batch is worked off in, at most its size: less memory, the same update.
    pub accumulate: usize,
    /// Smallest and largest share of the tokens the renderer is given; drawn per step.
    pub keep_tokens: [f64; 2],
    /// A run directory or a `model.safetensors` to start from.
    pub init_from: Option<PathBuf>,
    /// The update rule.
    pub optimizer: OptimizerConfig,
}

impl Default for Stage1Config {
    fn default() -> Self {
        Self {
            steps: 90_000,
            batch_size: 64,
            accumulate: 1,
            keep_tokens: [0.25, 1.0],
            init_from: None,
            optimizer: OptimizerConfig::default(),
        }
    }
}

/// The offline cluster cache: latent K-means of the trained encoder's tokens.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ClustersConfig {
    /// What stage 2 learns to condense: clusters of latent K-means (`kmeans`), or tiles of the views (`tile`), which
    /// the paper compares them with.
    pub grouping: Grouping,
    /// Token counts that stage 2 trains on. Departs from the reference, which draws any ratio per
    /// scene and pads: a shared grid makes dense batches.
    pub grid: Vec<TokenCount>,
    /// Context sets per scene.
    pub num_passes: usize,
    /// Scenes that are clustered; 0 for all.
    pub num_scenes: usize,
    /// Latent K-means.
    pub kmeans: KMeans,
}

impl Default for ClustersConfig {
    fn default() -> Self {
        let shares = [1.0 / 32.0, 1.0 / 16.0, 0.125, 0.1875, 0.25, 0.375, 0.5, 0.625, 0.75, 0.875, 1.0];
        Self {
            grouping: Grouping::Kmeans,
            grid: shares.map(TokenCount::Share).into(),
            num_passes: 3,
            num_scenes: 0,
            kmeans: KMeans::default(),
        }
    }
}

/// Stage 2: condenser at the full rate, renderer at a fraction of it, encoder frozen.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Stage2Config {
    /// Optimiser updates.
    pub steps: u64,
    /// Scenes per update.
    pub batch_size: usize,
    /// Parts a batch is worked off in, at most its size: less memory, the same update.
    pub accumulate: usize,
    /// Learning rate of the renderer over that of the condenser.
    pub renderer_lr_factor: f64,
    /// The update rule.
    pub optimizer: OptimizerConfig,
}

impl Default for Stage2Config {
    fn default() -> Self {
        Self {
            steps: 50_000,
            batch_size: 80,
            accumulate: 1,
            renderer_lr_factor: 0.1,
            optimizer: OptimizerConfig::default(),
        }
    }
}

/// How often the state of a run is saved.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CheckpointConfig {
    /// Steps between checkpoints; 0 saves at the end of a stage only.
    pub every: u64,
    /// How many of the latest are kept.
    pub keep: usize,
    /// Whether the one with the best validation is kept too, of those whose step is validated (`eval.every`).
    pub keep_best: bool,
    /// Keeps every checkpoint whose step is a multiple of this, which is one of `every`; 0 keeps none for that.
    pub keep_every: u64,
}

impl Default for CheckpointConfig {
    fn default() -> Self {
        Self { every: 1000, keep: 2, keep_best: true, keep_every: 0 }
    }
}

#[cfg(test)]
mod tests {
    use clift_data::{Crop, SourceKind};

    use super::*;

    #[test]
    fn values_out_of_range_are_named_with_the_fix() {
        let mut config = Config { run_dir: "run".into(), ..Config::default() };
        let message = config.validate().unwrap_err().to_string();
        assert!(message.starts_with("`data.width, data.height` = 256, 256: synthetic scenes are 32 x 32"), "{message}");
        (config.data.synthetic.width, config.data.synthetic.height) = (256, 256);
        config.validate().expect("the default is valid");
        config.stage1.keep_tokens = [0.5, 0.25];
        let message = config.validate().unwrap_err().to_string();
        assert_eq!(message, "`stage1.keep_tokens` = [0.5, 0.25]: write 0 < smallest <= largest <= 1");
        config.stage1.keep_tokens = [0.25, 1.0];
        config.loss.perceptual_weight = -0.5;
        let message = config.validate().unwrap_err().to_string();
        assert_eq!(message, "`loss.perceptual_weight` = -0.5: write 0 or a positive number");
        config.loss.perceptual_weight = 0.5;
        config.validate().expect("to be measured a run needs no weights of its loss");
        let message = config.loss.weights().unwrap_err().to_string();
        assert!(
            message.starts_with("`loss.vgg_weights` = missing") && message.contains(PERCEPTUAL_COMMAND),
            "{message}"
        );
        config.loss.vgg_weights = Some("no/such/file".into());
        let message = config.loss.weights().unwrap_err().to_string();
        assert!(message.contains("no such file") && message.contains(PERCEPTUAL_COMMAND), "{message}");
        (config.data.width, config.data.height) = (8, 256);
        assert!(config.validate().unwrap_err().to_string().contains("16 x 16"), "too small for the network");
        (config.data.width, config.data.height) = (256, 256);
        config.loss.perceptual_weight = 0.0;
        assert_eq!(config.loss.weights().expect("no term"), None);
        config.clusters.grid = vec![TokenCount::Count(5000)];
        let message = config.validate().unwrap_err().to_string();
        assert_eq!(message, "`clusters.grid` = 5000: a scene has as few as 4096 tokens");
        config.clusters.grid = vec![TokenCount::Count(64)];
        config.data.views.min_context = 0;
        assert!(config.validate().is_err(), "and no panic");
        config.data.views.min_context = 4;
        config.stage1.optimizer.weight_decay = f64::NAN;
        assert!(config.validate().unwrap_err().to_string().starts_with("`stage1.optimizer.weight_decay` = NaN"));
        config.stage1.optimizer.weight_decay = 0.05;
        config.data.source = SourceKind::Chunks;
        assert!(config.validate().unwrap_err().to_string().starts_with("`data.root` = missing"));
    }

    #[test]
    fn younger_keys_are_not_written_by_default_so_that_older_runs_resume() {
        let written = |config: &Config| toml::Table::try_from(config).unwrap()["data"].clone();
        let mut config = Config::default();
        let data = written(&config);
        assert!(["crop", "flip"].iter().all(|key| data.get(key).is_none()) && data["views"].get("inner").is_none());
        assert!(!config.data.clip_options().exact_principal_point);
        (config.data.crop, config.data.flip) = (Crop::Exact, true);
        let data = written(&config);
        assert_eq!((data["crop"].as_str(), data["flip"].as_bool()), (Some("exact"), Some(true)));
        assert!(config.data.clip_options().exact_principal_point);
        config.data.crop = Crop::Protocol;
        config.data.exact_principal_point = true;
        assert!(config.data.clip_options().exact_principal_point);
    }
}
