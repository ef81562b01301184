//! Parameters and multiplications of a network, counted from its sizes.
// N tokens, M projected tokens, R rendered tokens, S stored tokens, Q patches of a view, T target views, D width,
// F feed-forward width

use clift_model::ModelConfig;
use serde::Serialize;

/// Parameters of the three networks.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Parameters {
    /// Of the encoder; stage 1 trains it.
    pub encoder: u64,
    /// Of the condenser; stage 2 trains it.
    pub condenser: u64,
    /// Of the renderer; both stages train it.
    pub renderer: u64,
    /// Of all three.
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
        let condenser = blocks(config.condenser.num_blocks, condenser_block(config));
        let renderer = linear(config.ray_patch_len(), config.dim)
            + blocks(config.num_renderer_blocks, decoder_block(config))
            + 2 * dim
            + linear(config.dim, config.rgb_patch_len());
        Self { encoder, condenser, renderer, total: encoder + condenser + renderer }
    }
}

/// Of the queries, keys, values and output projection among a set's own members.
fn self_attention(config: &ModelConfig) -> u64 {
    let dim = config.dim as u64;
    4 * dim * dim + 4 * dim
}

fn feed_forward(config: &ModelConfig) -> u64 {
    let (dim, hidden) = (config.dim as u64, config.feed_forward_dim as u64);
    2 * dim * hidden + dim + hidden
}

/// Parameters of one encoder block.
pub fn encoder_block(config: &ModelConfig) -> u64 {
    4 * config.dim as u64 + self_attention(config) + feed_forward(config)
}

/// Parameters of one decoder block: a norm and a cross-attention more.
pub fn decoder_block(config: &ModelConfig) -> u64 {
    6 * config.dim as u64 + 2 * self_attention(config) + feed_forward(config)
}

/// Parameters of one condenser block: with residuals a norm more than that, and the gate, which has no bias.
pub fn condenser_block(config: &ModelConfig) -> u64 {
    let dim = config.dim as u64;
    let norms = if config.condenser.residual { 4 } else { 3 };
    2 * norms * dim + 2 * self_attention(config) + feed_forward(config) + dim * dim
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
            let members = num_tokens - stored;
            let cross = 2.0 * stored * dim * dim + 2.0 * members * dim * dim + 2.0 * members * dim;
            config.condenser.num_blocks as f64 * (among(stored) + cross + stored * dim * dim)
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
    use clift_model::{Clift, CondenserConfig};

    use super::*;

    #[test]
    fn parameters_are_counted_exactly() {
        for residual in [false, true] {
            for [num_encoder_blocks, num_renderer_blocks, num_blocks] in [[1, 2, 3], [3, 1, 1]] {
                let config = ModelConfig {
                    dim: 24,
                    num_heads: 3,
                    feed_forward_dim: 40,
                    num_encoder_blocks,
                    num_renderer_blocks,
                    patch_size: 4,
                    condenser: CondenserConfig { num_blocks, residual },
                    ..ModelConfig::default()
                };
                let model = Clift::new(&config, 0, &Device::flex());
                let counted = Parameters::of(&config);
                let [encoder, condenser, renderer] =
                    [model.encoder.num_params(), model.condenser.num_params(), model.renderer.num_params()];
                assert_eq!(
                    [counted.encoder, counted.condenser, counted.renderer],
                    [encoder, condenser, renderer].map(|count| count as u64)
                );
                assert_eq!(counted.total, model.num_params() as u64);
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
