//! The one description of the networks: every layer with its path, its sizes and the rows of its input.
//!
//! Parameter names and counts, multiply-accumulates, memory and published names are derived from this list.

use crate::network::architecture::Architecture;
use crate::network::blocks::feed_forward::Activation;
use crate::network::config::ModelConfig;

#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Layer {
    /// Path of its module, such as `encoder.blocks.0.attn.in_proj`.
    pub path: String,
    pub part: Part,
    /// Index of its transformer block; `None` outside the blocks.
    pub block: Option<usize>,
    pub kind: LayerKind,
    pub rows: Sequence,
    /// Whether the layer saves its input for the backward. A linear layer after a norm or an activation recomputes its
    /// input; layers that project a scene's tokens share one copy of them.
    pub saves_input: bool,
}

/// A network with weights of its own.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// Context views to light-field tokens.
    Encoder,
    /// Norm of the encoder's tokens.
    TokenNorm,
    /// Encoder tokens to storage tokens.
    Condenser,
    /// Tokens and a camera to an image.
    Renderer,
}

/// Rows of a layer's input, counted by [`SceneSizes`](crate::cost::scene_sizes::SceneSizes).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Rows {
    /// Patches of all context views, and their tokens.
    ContextPatches,
    /// Tokens that are encoded beside the patches.
    Latents,
    /// Tokens that are not centroids.
    Members,
    /// Centroids.
    StoredTokens,
    /// Centroids in cross-attention, which the condenser skips without members.
    GatheringTokens,
    /// Tokens from which a view is rendered.
    RenderTokens,
    /// Patches of the target views.
    TargetPatches,
}

/// Rows that form one sequence, usually of one kind.
pub type Sequence = &'static [Rows];

/// Operation of a layer with its width: of all heads together, except in [`LayerKind::HeadNorm`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LayerKind {
    /// Product with a matrix; a vector is added with `bias`.
    Linear { inputs: usize, outputs: usize, bias: bool },
    /// Layer norm of every row; a vector is added with `bias`.
    LayerNorm { width: usize, bias: bool },
    /// RMS norm of every head of queries or keys; the heads share one scale.
    HeadNorm { width: usize, heads: usize },
    /// Softmax attention of every row to all keys of its group.
    Attention { width: usize, heads: usize, keys: Sequence },
    /// Softmax attention of every centroid to the keys of its cluster; each key belongs to one centroid.
    ClusterAttention { width: usize, keys: Sequence },
    /// Activation between the layers of a feed-forward network.
    Activation { width: usize, activation: Activation },
    /// Learned rows, beside the layer's input.
    Table { rows: usize, width: usize },
}

impl Layer {
    /// Returns path and shape of every parameter in a weight file; linear weights are `[outputs, inputs]`.
    pub fn parameters(&self) -> Vec<(String, Vec<usize>)> {
        let shapes = match self.kind {
            LayerKind::Linear { inputs, outputs, bias: true } => vec![vec![outputs, inputs], vec![outputs]],
            LayerKind::Linear { inputs, outputs, bias: false } => vec![vec![outputs, inputs]],
            LayerKind::LayerNorm { width, bias: true } => vec![vec![width], vec![width]],
            LayerKind::LayerNorm { width, bias: false } | LayerKind::HeadNorm { width, .. } => vec![vec![width]],
            LayerKind::Table { rows, width } => vec![vec![1, rows, width]],
            LayerKind::Attention { .. } | LayerKind::ClusterAttention { .. } | LayerKind::Activation { .. } => vec![],
        };
        let paths = ["weight", "bias"].map(|name| format!("{}.{name}", self.path));
        paths.into_iter().zip(shapes).collect()
    }

    pub fn num_parameters(&self) -> u64 {
        self.parameters().iter().map(|(_, shape)| shape.iter().product::<usize>() as u64).sum()
    }
}

// Sequences of the architectures' layers
const CONTEXT: Sequence = &[Rows::ContextPatches];
const MEMBERS: Sequence = &[Rows::Members];
const STORED: Sequence = &[Rows::StoredTokens];
const GATHERING: Sequence = &[Rows::GatheringTokens];
pub(crate) const RENDER_TOKENS: Sequence = &[Rows::RenderTokens];
const TARGETS: Sequence = &[Rows::TargetPatches];
const LATENTS: Sequence = &[Rows::Latents];
const LATENTS_AND_CONTEXT: Sequence = &[Rows::Latents, Rows::ContextPatches];
pub(crate) const TARGETS_AND_TOKENS: Sequence = &[Rows::TargetPatches, Rows::RenderTokens];

impl ModelConfig {
    /// Lists every layer in the order of published checkpoints: encoder, token norm, renderer, condenser; within a block
    /// attention, feed-forward network, norms.
    pub(crate) fn layers(&self) -> Vec<Layer> {
        let (path, layers) = (String::new(), Vec::new());
        let mut list = LayerList { config: self, path, part: Part::Encoder, block: None, layers };
        list.encoder();
        list.renderer();
        list.condenser();
        list.layers
    }
}

/// The layers listed so far, and the network, block and path of the next ones.
struct LayerList<'a> {
    config: &'a ModelConfig,
    path: String,
    part: Part,
    block: Option<usize>,
    layers: Vec<Layer>,
}

impl LayerList<'_> {
    fn encoder(&mut self) {
        let (config, is_lvsm) = (self.config, self.is_lvsm());
        self.enter(Part::Encoder, None, "encoder");
        self.linear("patch_embed", [config.context_patch_len(), config.dim], CONTEXT, true);
        if is_lvsm {
            let latents = LayerKind::Table { rows: config.num_latents, width: config.dim };
            self.push("latents", latents, LATENTS_AND_CONTEXT, false);
        }
        let rows = if is_lvsm { LATENTS_AND_CONTEXT } else { CONTEXT };
        for i in 0..config.num_encoder_blocks {
            self.enter(Part::Encoder, Some(i), &format!("encoder.blocks.{i}"));
            // The last block of LVSM's networks computes the rows that are read after it.
            let is_last = i + 1 == config.num_encoder_blocks;
            self.encoder_block(rows, if is_lvsm && is_last { LATENTS } else { rows });
        }
        if config.has_token_norm() {
            self.enter(Part::TokenNorm, None, "lift_norm");
            self.norm("norm", CONTEXT);
        }
    }

    fn renderer(&mut self) {
        let config = self.config;
        self.enter(Part::Renderer, None, "renderer");
        self.linear("ray_embed", [config.ray_patch_len(), config.dim], TARGETS, true);
        if self.is_lvsm() {
            self.norm("joint.input_norm", TARGETS_AND_TOKENS);
        }
        for i in 0..config.num_renderer_blocks {
            if self.is_lvsm() {
                self.enter(Part::Renderer, Some(i), &format!("renderer.joint.blocks.{i}"));
                let is_last = i + 1 == config.num_renderer_blocks;
                self.encoder_block(TARGETS_AND_TOKENS, if is_last { TARGETS } else { TARGETS_AND_TOKENS });
            } else {
                self.enter(Part::Renderer, Some(i), &format!("renderer.blocks.{i}"));
                self.decoder_block(TARGETS, RENDER_TOKENS);
            }
        }
        self.enter(Part::Renderer, None, "renderer");
        self.norm("output_norm", TARGETS);
        self.linear("to_pixels", [config.dim, config.rgb_patch_len()], TARGETS, false);
    }

    fn condenser(&mut self) {
        let ModelConfig { dim, variant, condenser, .. } = self.config;
        let dim = *dim;
        if variant.is_released() {
            self.enter(Part::Condenser, Some(0), "condenser.released");
            self.decoder_block(STORED, CONTEXT);
            self.linear("gate", [dim; 2], STORED, true);
            return;
        }
        for i in 0..condenser.num_blocks {
            self.enter(Part::Condenser, Some(i), &format!("condenser.blocks.{i}"));
            self.self_attention("self_attn", STORED, STORED);
            self.norm("norm_self", STORED);
            if condenser.residual {
                self.norm("norm_cross", GATHERING);
            }
            // All blocks share one copy of the members.
            self.push("norm_memory", LayerKind::LayerNorm { width: dim, bias: true }, MEMBERS, false);
            self.norm("norm_ff", STORED);
            self.cross_attention(GATHERING, !condenser.residual, MEMBERS);
            self.feed_forward(STORED);
            self.push("gate", LayerKind::Linear { inputs: dim, outputs: dim, bias: false }, STORED, true);
        }
    }

    fn is_lvsm(&self) -> bool {
        self.config.architecture == Architecture::LvsmEd
    }

    /// Starts the layers below a path, of a block or outside the blocks.
    fn enter(&mut self, part: Part, block: Option<usize>, path: &str) {
        (self.part, self.block, self.path) = (part, block, path.to_owned());
    }

    fn push(&mut self, name: &str, kind: LayerKind, rows: Sequence, saves_input: bool) {
        let path = format!("{}.{name}", self.path);
        self.layers.push(Layer { path, part: self.part, block: self.block, kind, rows, saves_input });
    }

    fn linear(&mut self, name: &str, [inputs, outputs]: [usize; 2], rows: Sequence, saves_input: bool) {
        let bias = self.config.has_biases();
        self.push(name, LayerKind::Linear { inputs, outputs, bias }, rows, saves_input);
    }

    fn norm(&mut self, name: &str, rows: Sequence) {
        let bias = self.config.has_biases();
        self.push(name, LayerKind::LayerNorm { width: self.config.dim, bias }, rows, true);
    }

    /// Adds self-attention of the first rows, `queries`, to all after a norm, with one packed projection.
    fn self_attention(&mut self, name: &str, rows: Sequence, queries: Sequence) {
        let ModelConfig { dim, num_heads, .. } = *self.config;
        self.linear(&format!("{name}.in_proj"), [dim, 3 * dim], rows, false);
        self.push(name, LayerKind::Attention { width: dim, heads: num_heads, keys: rows }, queries, true);
        self.attention_output(name, queries, rows);
    }

    /// Adds cross-attention: in the condenser to the tokens of a cluster, in the renderer to all.
    fn cross_attention(&mut self, rows: Sequence, saves_query: bool, keys: Sequence) {
        let ModelConfig { dim: width, num_heads: heads, .. } = *self.config;
        let (name, kind) = match self.part {
            Part::Condenser => ("cluster_attn", LayerKind::ClusterAttention { width, keys }),
            _ => ("cross_attn", LayerKind::Attention { width, heads, keys }),
        };
        self.linear(&format!("{name}.q_proj"), [width, width], rows, saves_query);
        self.linear(&format!("{name}.kv_proj"), [width, 2 * width], keys, false);
        self.push(name, kind, rows, true);
        self.attention_output(name, rows, keys);
    }

    fn attention_output(&mut self, name: &str, rows: Sequence, keys: Sequence) {
        let ModelConfig { dim, num_heads: heads, .. } = *self.config;
        self.linear(&format!("{name}.out_proj"), [dim, dim], rows, true);
        if self.config.has_query_key_norms() && self.part != Part::Condenser {
            let norm = LayerKind::HeadNorm { width: dim / heads, heads };
            self.push(&format!("{name}.qk_norm.query"), norm, rows, true);
            self.push(&format!("{name}.qk_norm.key"), norm, keys, true);
        }
    }

    fn feed_forward(&mut self, rows: Sequence) {
        let ModelConfig { dim, feed_forward_dim: hidden, .. } = *self.config;
        self.linear("feed_forward.up", [dim, hidden], rows, false);
        let is_relu = self.part == Part::Condenser && self.config.variant.is_released();
        let activation = if is_relu { Activation::Relu } else { Activation::Gelu };
        self.push("feed_forward", LayerKind::Activation { width: hidden, activation }, rows, true);
        self.linear("feed_forward.down", [hidden, dim], rows, false);
    }

    /// Adds PyTorch's pre-norm encoder layer, which computes the first rows, `outputs`.
    fn encoder_block(&mut self, rows: Sequence, outputs: Sequence) {
        self.self_attention("attn", rows, outputs);
        self.feed_forward(outputs);
        self.norm("norm_attn", rows);
        self.norm("norm_ff", outputs);
    }

    fn decoder_block(&mut self, rows: Sequence, keys: Sequence) {
        self.self_attention("self_attn", rows, rows);
        self.cross_attention(rows, false, keys);
        self.feed_forward(rows);
        for name in ["norm_self", "norm_cross", "norm_ff"] {
            self.norm(name, rows);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use burn::module::Module;
    use burn::tensor::Device;

    use super::*;
    use crate::cost::parameters::Parameters;
    use crate::network::model::Network;
    use crate::testing::small_configs;
    use crate::weights::file::save_weights;

    #[test]
    fn layers_are_those_of_the_built_module() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("model.safetensors");
        for config in small_configs() {
            let model = Network::new(&config, 0, &Device::flex());
            save_weights(&model, &path).expect("writes");
            let bytes = std::fs::read(&path).expect("reads");
            let file = safetensors::SafeTensors::deserialize(&bytes).expect("valid");
            let built: BTreeMap<String, Vec<usize>> =
                file.tensors().into_iter().map(|(name, view)| (name, view.shape().to_vec())).collect();
            let listed: BTreeMap<_, _> = config.layers().iter().flat_map(Layer::parameters).collect();
            assert_eq!(listed, built, "{config:?}");

            let Parameters { encoder, lift_norm, condenser, renderer, total } = Parameters::of(&config);
            assert_eq!(
                [encoder, lift_norm, condenser, renderer, total].map(|count| count as usize),
                [
                    model.encoder.num_params(),
                    model.lift_norm.as_ref().map_or(0, Module::num_params),
                    model.condenser.num_params(),
                    model.renderer.num_params(),
                    model.num_params(),
                ]
            );
        }
    }
}
