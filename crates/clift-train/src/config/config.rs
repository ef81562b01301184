//! One config file per experiment: `[data] [model] [loss] [stage1] [clusters] [stage2] [checkpoint] [eval]`.

use std::path::{Path, PathBuf};

use clift_core::derive_seed;
use clift_data::DataConfig;
use clift_eval::{EvalConfig, Sweep};
use clift_model::{DeviceName, Grouping, KMeans, ModelConfig, PERCEPTUAL_COMMAND, Precision, TokenCount};
use serde::{Deserialize, Serialize};

use crate::error::{TrainError, bad};
use crate::events::{RunStep, Stage};

/// Most tokens of a scene: ids are stored in 16 bits.
pub const MAX_TOKENS: usize = 1 << 16;

/// An experiment.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Directory of all files of the run.
    pub run_dir: PathBuf,
    /// Seed of initial weights, scene order, views and token subsets.
    #[serde(default)]
    pub seed: u64,
    /// Device: `flex`, `ndarray` or `wgpu`.
    #[serde(default)]
    pub device: DeviceName,
    /// Operands of matrix products in training: `f32`, `bf16` on the CPU if the processor has AVX-512 BF16, or `f16` if
    /// the device supports f16. Weights, sums, norms, softmax, loss and optimizer are f32 in all.
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
    #[serde(default)]
    pub stage2: Stage2Config,
    /// When checkpoints are saved.
    #[serde(default)]
    pub checkpoint: CheckpointConfig,
    /// Validation during training, and evaluation after it.
    #[serde(default)]
    pub eval: EvalConfig,
}

impl Config {
    /// Returns the step of stage 1 whose gaps between contexts stage 2 has: the last one, or the last of the warm-up of the
    /// gaps where stage 1 has no steps, because the run starts from a trained model.
    pub fn last_gap_step(&self) -> u64 {
        let warm_up_steps = self.data.views.warm_up_steps;
        if self.stage1.steps == 0 { warm_up_steps } else { self.stage1.steps.min(warm_up_steps) }
    }

    /// Returns the steps of a run in their order.
    pub fn run_steps(&self) -> &'static [RunStep] {
        if self.model.architecture.supports_clusters() {
            &[RunStep::Train(Stage::Stage1), RunStep::Clusters, RunStep::Train(Stage::Stage2), RunStep::Eval]
        } else {
            &[RunStep::Train(Stage::Stage1), RunStep::Eval]
        }
    }

    /// Returns the token counts of stored scenes in an evaluation: those of `eval`, or all tokens of a network without
    /// clusters.
    pub fn eval_stored_tokens(&self) -> Vec<TokenCount> {
        if self.model.architecture.supports_clusters() {
            self.eval.stored_tokens.clone()
        } else {
            vec![TokenCount::Share(1.0)]
        }
    }

    /// Returns the files and folders that a run of this config reads.
    pub fn input_paths(&self) -> Vec<PathBuf> {
        let Self { data, stage1, stage2, loss, eval, .. } = self;
        let weights = [&stage1.init_from, &stage2.init_from, &loss.vgg_weights, &eval.lpips_weights];
        weights.into_iter().chain([&data.root, &eval.index]).flatten().cloned().collect()
    }

    /// Returns the settings of an evaluation, without LPIPS.
    pub(crate) fn sweep(&self) -> Sweep {
        let Self { seed, clusters, model, device, eval, .. } = self;
        Sweep {
            eval: eval.clone(),
            model_path: self.run_dir.display().to_string(),
            kmeans: clusters.kmeans.clone(),
            model: model.clone(),
            lpips: None,
            is_cpu: device.is_cpu(),
            checks_contexts: false,
            seed: derive_seed(*seed, "eval"),
        }
    }
}

/// The training loss: mean squared error plus a weighted perceptual term (paper section 3.3).
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LossConfig {
    /// Whether the mean over the target views of `0.01 ln(1 + MSE / 0.0001)` replaces the mean squared error: easy views
    /// count as much as hard ones, as in a mean PSNR.
    pub log_mse: bool,
    /// Weight of the perceptual term, 0.5 in the paper. 0: mean squared error only.
    pub perceptual_weight: f64,
    /// Weights of the VGG-19 network published by MatConvNet, converted by `scripts/tools/convert_vgg.py`.
    pub vgg_weights: Option<PathBuf>,
}

impl LossConfig {
    /// Returns the path of the VGG weights if there is a perceptual term.
    pub fn weights(&self) -> Result<Option<&Path>, TrainError> {
        if self.perceptual_weight == 0.0 {
            return Ok(None);
        }
        let fix =
            |what: &str| format!("{what}; make them with `{PERCEPTUAL_COMMAND}`, or write loss.perceptual_weight = 0");
        match self.vgg_weights.as_deref() {
            None => Err(bad("loss.vgg_weights", "missing", &fix("the perceptual term needs the weights of VGG-19"))),
            Some(path) if !path.is_file() => Err(bad("loss.vgg_weights", path.display(), &fix("file not found"))),
            Some(path) => Ok(Some(path)),
        }
    }
}

/// Optimizer of the weight matrices of transformer blocks. All other parameters have AdamW.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Algorithm {
    /// AdamW, as in the paper.
    #[default]
    Adamw,
    /// Muon: momentum, then the nearest orthogonal matrix by five Newton-Schulz steps.
    Muon,
}

/// Learning rate after the warm-up.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Schedule {
    /// Half a cosine down to 0.
    #[default]
    Cosine,
    /// Warm-up, stable, decay: constant, and linear to 0 in the last half of the steps (arXiv 2404.06395).
    Wsd,
}

/// AdamW or Muon, with warm-up and decay.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct OptimizerConfig {
    /// Optimizer of the weight matrices of transformer blocks: `adamw`, or `muon`, which learns more per step.
    pub algorithm: Algorithm,
    /// Decay of the learning rate after the warm-up: `cosine`, or `wsd`: constant, and linear to 0 in the last half of the
    /// steps.
    pub schedule: Schedule,
    /// Highest learning rate.
    pub learning_rate: f64,
    /// Steps until this rate is reached.
    pub warm_up_steps: u64,
    /// Decay rates of AdamW's first and second moment.
    pub betas: [f64; 2],
    /// Decoupled weight decay, on every parameter as in the released code.
    pub weight_decay: f64,
    /// Gradients are scaled down to this global norm.
    pub max_grad_norm: f64,
    /// A step is skipped if its loss or gradient norm exceeds this factor times the median of the last 101 good steps. 0:
    /// only steps that are not finite are skipped.
    pub spike_factor: f64,
    /// Number of consecutive skipped steps after which the run stops.
    pub max_bad_steps: u32,
}

impl Default for OptimizerConfig {
    fn default() -> Self {
        Self {
            algorithm: Algorithm::Adamw,
            schedule: Schedule::Cosine,
            learning_rate: 4e-4,
            warm_up_steps: 2500,
            betas: [0.9, 0.95],
            weight_decay: 0.05,
            max_grad_norm: 1.0,
            // Training of `tiny.toml` stays below 2 times the median loss and 4.3 times the median gradient norm.
            spike_factor: 100.0,
            max_bad_steps: 3,
        }
    }
}

/// Stage 1: encoder and renderer, on random subsets of the tokens.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Stage1Config {
    /// Number of optimizer updates.
    pub steps: u64,
    /// Share of the updates, the first ones, whose images have half the width and height. They take a fraction of the time.
    /// Validation has whole images.
    pub half_resolution: f64,
    /// Further sizes of the images, `[width, height]` in pixels, at most as many pixels as `data.width` x `data.height`; every
    /// update has one of all sizes, drawn at random. Validation has `data.width` x `data.height`.
    pub further_sizes: Vec<[usize; 2]>,
    /// Scenes per update.
    pub batch_size: usize,
    /// Number of micro-batches per update, at most the batch size. Less memory, same gradients. Several ranks share them, as do
    /// the threads of `flex`.
    pub accumulate: usize,
    /// Smallest and largest share of the tokens that the renderer receives; the share is sampled every step.
    pub keep_tokens: [f64; 2],
    /// Run or model directory, or `model.safetensors`, of the initial weights. A network with patches half as long, or a third
    /// and so on, is adapted: training goes on at a higher resolution.
    pub init_from: Option<PathBuf>,
    /// Settings of the optimizer.
    pub optimizer: OptimizerConfig,
}

impl Default for Stage1Config {
    fn default() -> Self {
        Self {
            steps: 90_000,
            half_resolution: 0.0,
            further_sizes: Vec::new(),
            batch_size: 64,
            accumulate: 1,
            keep_tokens: [0.25, 1.0],
            init_from: None,
            optimizer: OptimizerConfig::default(),
        }
    }
}

/// The offline cluster cache: groups of the trained encoder's tokens.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ClustersConfig {
    /// Groups of tokens that stage 2 condenses: clusters of latent K-means (`kmeans`), or tiles of the views (`tile`), the
    /// baseline of the paper.
    pub grouping: Grouping,
    /// Token counts that stage 2 trains on. Differs from the released code, which samples any ratio per scene and pads: batches
    /// from a grid need no padding.
    pub grid: Vec<TokenCount>,
    /// Number of context sets per scene.
    pub num_passes: usize,
    /// Number of scenes to cluster; 0 for all.
    pub num_scenes: usize,
    /// Settings of latent K-means.
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

/// Stage 2: condenser at the full learning rate, renderer at a fraction, encoder frozen.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Stage2Config {
    /// Number of optimizer updates.
    pub steps: u64,
    /// Scenes per update.
    pub batch_size: usize,
    /// Number of micro-batches per update, at most the batch size. Less memory, same gradients. Several ranks share them, as do
    /// the threads of `flex`.
    pub accumulate: usize,
    /// Learning rate of the renderer, as a factor of the condenser's.
    pub renderer_lr_factor: f64,
    /// Position of the saved weights on the line from those at the start of the stage (0) to the trained ones (1); of a
    /// condenser that starts untrained, the position of the gates. Checkpoints and validations have the trained weights.
    pub weight_interpolation: f64,
    /// Run or model directory, or `model.safetensors`, of the initial condenser.
    pub init_from: Option<PathBuf>,
    /// Settings of the optimizer.
    pub optimizer: OptimizerConfig,
}

impl Default for Stage2Config {
    fn default() -> Self {
        Self {
            steps: 50_000,
            batch_size: 80,
            accumulate: 1,
            renderer_lr_factor: 0.1,
            weight_interpolation: 1.0,
            init_from: None,
            optimizer: OptimizerConfig::default(),
        }
    }
}

/// When checkpoints are saved, and which are kept.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CheckpointConfig {
    /// Steps between checkpoints; 0 saves only at the end of a stage.
    pub every: u64,
    /// Number of latest checkpoints to keep.
    pub keep: usize,
}

impl Default for CheckpointConfig {
    fn default() -> Self {
        Self { every: 1000, keep: 2 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    type Change = fn(&mut Config);

    fn changed(change: Change) -> Config {
        let mut config = Config { run_dir: "run".into(), ..Config::default() };
        (config.data.synthetic.width, config.data.synthetic.height) = (256, 256);
        config.validate().expect("the default is valid");
        change(&mut config);
        config
    }

    // `tests/snapshots` has the messages of other keys.
    #[test]
    fn invalid_values_are_named_with_the_fix() {
        let cases: [(Change, &str); 8] = [
            (
                |c| (c.loss.perceptual_weight, c.stage1.further_sizes) = (0.5, vec![[8, 64]]),
                "`stage1.further_sizes` = [8, 64]: VGG-19 needs 16 pixels: write longer sides, or loss.perceptual_weight = 0",
            ),
            (|c| c.loss.perceptual_weight = -0.5, "`loss.perceptual_weight` = -0.5: write 0 or a positive number"),
            (
                |c| (c.loss.perceptual_weight, c.data.width) = (0.5, 8),
                "`loss.perceptual_weight` = 0.5: VGG-19 needs images of at least 16 x 16, not 8 x 256: write 0",
            ),
            (
                |c| c.stage1.further_sizes = vec![[128, 100]],
                "`stage1.further_sizes` = [128, 100]: write multiples of model.patch_size = 8",
            ),
            (
                |c| c.stage1.further_sizes = vec![[512, 256]],
                "`stage1.further_sizes` = [512, 256]: write a size of at most 65536 pixels, as data.width x data.height",
            ),
            (
                |c| c.stage2.optimizer.betas = [0.9, 1.0],
                "`stage2.optimizer.betas` = [0.9, 1.0]: write two numbers of at least 0, below 1",
            ),
            (
                |c| (c.stage1.half_resolution, c.data.height) = (0.5, 248),
                "`stage1.half_resolution` = 0.5: write 0, or a multiple of 2 x model.patch_size = 16 as data.height, not 248",
            ),
            (
                |c| (c.stage1.half_resolution, c.loss.perceptual_weight, c.data.width) = (0.5, 0.5, 16),
                "`stage1.half_resolution` = 0.5: write 0, or 32 or more as data.width, not 16: VGG-19 needs 16 pixels",
            ),
        ];
        for (change, expected) in cases {
            let config = changed(change);
            let refused = config.validate().and_then(|()| config.validate_half_resolution()).unwrap_err();
            assert_eq!(refused.to_string(), expected);
        }
    }
}
