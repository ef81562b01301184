//! Parameters and multiplications of a network, counted from its sizes.
// N tokens, M projected tokens, R rendered tokens, S stored tokens, Q patches of a view, T target views, D width,
// F feed-forward width

use clift_model::ModelConfig;
use clift_model::flops::Convention;
use serde::Serialize;

use crate::events::Stage;

/// Parameters of the networks.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Parameters {
    /// Of the encoder; stage 1 trains it.
    pub encoder: u64,
    /// Of the released DL3DV network's norm of the tokens, 0 elsewhere; both stages train it.
    pub lift_norm: u64,
    /// Of the condenser; stage 2 trains it.
    pub condenser: u64,
    /// Of the renderer; both stages train it.
    pub renderer: u64,
    /// Of all.
    pub total: u64,
}

impl Parameters {
    /// Counts them.
    pub fn of(config: &ModelConfig) -> Self {
        let dim = config.dim as u64;
        let linear = |inputs: usize, outputs: usize| (inputs * outputs + outputs) as u64;
        let blocks = |count: usize, one: u64| count as u64 * one;
        let encoder =
            linear(config.context_patch_len(), config.dim) + blocks(config.num_encoder_blocks, encoder_block(config));
        let lift_norm = if config.variant.has_norms() { 2 * dim } else { 0 };
        let condenser = blocks(config.condenser.num_blocks, condenser_block(config));
        let renderer = linear(config.ray_patch_len(), config.dim)
            + blocks(config.num_renderer_blocks, decoder_block(config))
            + 2 * dim
            + linear(config.dim, config.rgb_patch_len());
        Self { encoder, lift_norm, condenser, renderer, total: encoder + lift_norm + condenser + renderer }
    }

    /// Those that a stage trains.
    pub fn trained(&self, stage: Stage) -> u64 {
        let own = if stage == Stage::Stage2 { self.condenser } else { self.encoder };
        own + self.lift_norm + self.renderer
    }
}

/// Of the queries, keys, values and output projection of an attention, and the norms of its heads.
fn attention(config: &ModelConfig) -> u64 {
    let dim = config.dim as u64;
    let norms = if config.variant.has_norms() { 2 * dim / config.num_heads as u64 } else { 0 };
    4 * dim * dim + 4 * dim + norms
}

fn feed_forward(config: &ModelConfig) -> u64 {
    let (dim, hidden) = (config.dim as u64, config.feed_forward_dim as u64);
    2 * dim * hidden + dim + hidden
}

/// Parameters of one encoder block.
pub fn encoder_block(config: &ModelConfig) -> u64 {
    4 * config.dim as u64 + attention(config) + feed_forward(config)
}

/// Parameters of one decoder block: a norm and a cross-attention more.
pub fn decoder_block(config: &ModelConfig) -> u64 {
    6 * config.dim as u64 + 2 * attention(config) + feed_forward(config)
}

/// Parameters of one condenser block: a norm of the members, with residuals one of the queries, and the gate without a
/// bias; the released networks have no norm of the members and a bias.
pub fn condenser_block(config: &ModelConfig) -> u64 {
    let dim = config.dim as u64;
    let (norms, bias) = match (config.variant.is_released(), config.condenser.residual) {
        (true, _) => (3, dim),
        (false, true) => (4, 0),
        (false, false) => (3, 0),
    };
    2 * norms * dim + 2 * attention(config) + feed_forward(config) + dim * dim + bias
}

/// How much of everything one scene has.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SceneSizes {
    /// Encoder tokens, N.
    pub num_tokens: f64,
    /// Stored tokens, S; `None` without a condenser.
    pub num_storage_tokens: Option<f64>,
    /// Tokens that a view is drawn from, R.
    pub num_render_tokens: f64,
    /// Whether every view has tokens of its own.
    pub is_per_view: bool,
    /// Target views, T.
    pub num_targets: f64,
    /// Patches of a view, Q.
    pub num_patches: f64,
}

impl SceneSizes {
    /// Tokens that keys and values are projected for: those of a scene, or its views' subsets where that is fewer.
    pub fn num_projected(&self) -> f64 {
        let all = self.num_storage_tokens.unwrap_or(self.num_tokens);
        if self.is_per_view { all.min(self.num_targets * self.num_render_tokens) } else { self.num_render_tokens }
    }
}

/// Multiplications of a scene's forward pass, by network.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Macs {
    /// Context views to tokens.
    pub encoder: f64,
    /// Tokens to stored ones.
    pub condenser: f64,
    /// Tokens to all target views.
    pub renderer: f64,
}

impl Macs {
    /// Counts one scene.
    pub fn of(config: &ModelConfig, sizes: &SceneSizes) -> Self {
        let [dim, hidden] = [config.dim, config.feed_forward_dim].map(|width| width as f64);
        let SceneSizes { num_tokens, num_render_tokens, num_targets, num_patches, .. } = *sizes;
        // Four projections, two matrices of the feed-forward network, scores and sums of values.
        let among = |count: f64| count * (4.0 * dim * dim + 2.0 * dim * hidden) + 2.0 * count * count * dim;
        let encoder =
            num_tokens * config.context_patch_len() as f64 * dim + config.num_encoder_blocks as f64 * among(num_tokens);
        let condenser = sizes.num_storage_tokens.map_or(0.0, |stored| {
            config.condense_macs(num_tokens as usize, stored as usize).count(Convention::Macs) as f64
        });
        let cross = num_targets * (2.0 * num_patches * dim * dim + 2.0 * num_patches * num_render_tokens * dim)
            + 2.0 * sizes.num_projected() * dim * dim;
        let pixels = (config.ray_patch_len() + config.rgb_patch_len()) as f64;
        let renderer = num_targets * num_patches * pixels * dim
            + config.num_renderer_blocks as f64 * (num_targets * among(num_patches) + cross);
        Self { encoder, condenser, renderer }
    }

    /// Those of an update of stage 1: a forward and a backward pass of twice its multiplications, which is what linear
    /// layers take; `again` is a second forward.
    pub fn stage1_update(&self, again: bool) -> f64 {
        (if again { 4.0 } else { 3.0 }) * (self.encoder + self.renderer)
    }

    /// Those of an update of stage 2, whose encoder is frozen.
    pub fn stage2_update(&self, again: bool) -> f64 {
        self.encoder + (if again { 4.0 } else { 3.0 }) * (self.condenser + self.renderer)
    }
}

#[cfg(test)]
mod tests {
    use burn::module::Module;
    use burn::tensor::Device;
    use clift_model::{Clift, CondenserConfig, Variant};

    use super::*;

    #[test]
    fn parameters_are_counted_exactly() {
        let literal = CondenserConfig { residual: false, ..CondenserConfig::default() };
        let paper = [CondenserConfig::default(), literal].map(|condenser| (Variant::Paper, condenser));
        let released = [Variant::ReleasedRe10k, Variant::ReleasedDl3dv];
        let released = released.map(|variant| (variant, CondenserConfig::of(variant)));
        for (variant, condenser) in paper.into_iter().chain(released) {
            for [num_encoder_blocks, num_renderer_blocks, num_blocks] in [[1, 2, 3], [3, 1, 1]] {
                let num_blocks = if variant.is_released() { condenser.num_blocks } else { num_blocks };
                let config = ModelConfig {
                    variant,
                    dim: 24,
                    num_heads: 3,
                    feed_forward_dim: 40,
                    num_encoder_blocks,
                    num_renderer_blocks,
                    patch_size: 4,
                    condenser: CondenserConfig { num_blocks, ..condenser },
                };
                let model = Clift::new(&config, 0, &Device::flex());
                let counted = Parameters::of(&config);
                let [encoder, lift_norm, condenser, renderer] = [
                    model.encoder.num_params(),
                    model.lift_norm.num_params(),
                    model.condenser.num_params(),
                    model.renderer.num_params(),
                ]
                .map(|count| count as u64);
                let of_parts = [counted.encoder, counted.lift_norm, counted.condenser, counted.renderer];
                assert_eq!(of_parts, [encoder, lift_norm, condenser, renderer], "{variant}");
                assert_eq!(counted.total, model.num_params() as u64);
                assert_eq!(counted.trained(Stage::Stage1), encoder + lift_norm + renderer);
                assert_eq!(counted.trained(Stage::Stage2), condenser + lift_norm + renderer);
            }
        }
    }

    #[test]
    fn the_papers_renderer_has_the_multiplications_of_the_protocol() {
        // 41,523,609,600 + 7,077,888 R of linear layers and 9.664e9 + 9,437,184 R of attention, for one view of 1,024
        // patches.
        for tokens in [4096.0, 512.0] {
            let sizes = SceneSizes {
                num_tokens: 4096.0,
                num_storage_tokens: None,
                num_render_tokens: tokens,
                is_per_view: false,
                num_targets: 1.0,
                num_patches: 1024.0,
            };
            let expected = 41_523_609_600.0 + 7_077_888.0 * tokens + 9_663_676_416.0 + 9_437_184.0 * tokens;
            let macs = Macs::of(&ModelConfig::default(), &sizes);
            assert!((macs.renderer / expected - 1.0).abs() < 1e-9, "{} against {expected}", macs.renderer);
            assert!((macs.encoder / 291.7e9 - 1.0).abs() < 1e-3, "{}", macs.encoder);
        }
    }
}
