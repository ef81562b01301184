//! The one description of the networks: every layer with its path, its sizes and the rows of its input.
//!
//! Parameter names and counts, multiply-accumulates, memory, largest tensors and published names are derived from this
//! list. An architecture lists its layers in `Design::layers`.

use crate::network::blocks::feed_forward::Activation;
use crate::network::config::ModelConfig;
use crate::network::init::LayerStyle;

/// A layer of a network.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Layer {
    /// Path of its module, such as `encoder.blocks.0.attn.in_proj`.
    pub path: String,
    /// The network of the layer.
    pub part: Part,
    /// Index of its transformer block; `None` outside the blocks.
    pub block: Option<usize>,
    /// Operation and width.
    pub kind: LayerKind,
    /// Rows of the input.
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
    /// Matrix product.
    Linear { inputs: usize, outputs: usize, bias: bool },
    /// Layer norm with scale and, with `bias`, shift.
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

    /// Returns the number of parameters.
    pub fn num_parameters(&self) -> u64 {
        self.parameters().iter().map(|(_, shape)| shape.iter().product::<usize>() as u64).sum()
    }
}

// Sequences of the architectures' layers
pub(crate) const CONTEXT: Sequence = &[Rows::ContextPatches];
pub(crate) const MEMBERS: Sequence = &[Rows::Members];
pub(crate) const STORED: Sequence = &[Rows::StoredTokens];
pub(crate) const GATHERING: Sequence = &[Rows::GatheringTokens];
pub(crate) const RENDER_TOKENS: Sequence = &[Rows::RenderTokens];
pub(crate) const TARGETS: Sequence = &[Rows::TargetPatches];
pub(crate) const LATENTS: Sequence = &[Rows::Latents];
pub(crate) const LATENTS_AND_CONTEXT: Sequence = &[Rows::Latents, Rows::ContextPatches];
pub(crate) const TARGETS_AND_TOKENS: Sequence = &[Rows::TargetPatches, Rows::RenderTokens];

/// The layers listed so far, and the network, block and path of the next ones.
pub(crate) struct LayerList<'a> {
    config: &'a ModelConfig,
    /// The parameters of the next layers.
    pub style: LayerStyle,
    /// The activation of the next feed-forward networks.
    pub activation: Activation,
    path: String,
    part: Part,
    block: Option<usize>,
    pub layers: Vec<Layer>,
}

impl<'a> LayerList<'a> {
    pub fn new(config: &'a ModelConfig, style: LayerStyle) -> Self {
        let activation = Activation::Gelu;
        Self { config, style, activation, path: String::new(), part: Part::Encoder, block: None, layers: Vec::new() }
    }

    /// Starts the layers below a path, of a block or outside the blocks.
    pub fn enter(&mut self, part: Part, block: Option<usize>, path: &str) {
        (self.part, self.block, self.path) = (part, block, path.to_owned());
    }

    pub fn push(&mut self, name: &str, kind: LayerKind, rows: Sequence, saves_input: bool) {
        let path = format!("{}.{name}", self.path);
        self.layers.push(Layer { path, part: self.part, block: self.block, kind, rows, saves_input });
    }

    pub fn linear(&mut self, name: &str, [inputs, outputs]: [usize; 2], rows: Sequence, saves_input: bool) {
        let bias = self.style.has_biases;
        self.push(name, LayerKind::Linear { inputs, outputs, bias }, rows, saves_input);
    }

    pub fn norm(&mut self, name: &str, rows: Sequence) {
        let bias = self.style.has_biases;
        self.push(name, LayerKind::LayerNorm { width: self.config.dim, bias }, rows, true);
    }

    /// Adds self-attention of the first rows, `queries`, to all after a norm, with one packed projection.
    pub fn self_attention(&mut self, name: &str, rows: Sequence, queries: Sequence) {
        let ModelConfig { dim, num_heads, .. } = *self.config;
        self.linear(&format!("{name}.in_proj"), [dim, 3 * dim], rows, false);
        self.push(name, LayerKind::Attention { width: dim, heads: num_heads, keys: rows }, queries, true);
        self.attention_output(name, queries, rows);
    }

    /// Adds cross-attention: in the condenser to the tokens of a cluster, in the renderer to all.
    pub fn cross_attention(&mut self, rows: Sequence, saves_query: bool, keys: Sequence) {
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
        if self.style.has_query_key_norms && self.part != Part::Condenser {
            let norm = LayerKind::HeadNorm { width: dim / heads, heads };
            self.push(&format!("{name}.qk_norm.query"), norm, rows, true);
            self.push(&format!("{name}.qk_norm.key"), norm, keys, true);
        }
    }

    /// Adds the two layers of a feed-forward network.
    pub fn feed_forward(&mut self, rows: Sequence) {
        let ModelConfig { dim, feed_forward_dim: hidden, .. } = *self.config;
        self.linear("feed_forward.up", [dim, hidden], rows, false);
        self.push("feed_forward", LayerKind::Activation { width: hidden, activation: self.activation }, rows, true);
        self.linear("feed_forward.down", [hidden, dim], rows, false);
    }

    /// Adds PyTorch's pre-norm encoder layer, which computes the first rows, `outputs`.
    pub fn encoder_block(&mut self, rows: Sequence, outputs: Sequence) {
        self.self_attention("attn", rows, outputs);
        self.feed_forward(outputs);
        self.norm("norm_attn", rows);
        self.norm("norm_ff", outputs);
    }

    /// Adds PyTorch's pre-norm decoder layer.
    pub fn decoder_block(&mut self, rows: Sequence, keys: Sequence) {
        self.self_attention("self_attn", rows, rows);
        self.cross_attention(rows, false, keys);
        self.feed_forward(rows);
        for name in ["norm_self", "norm_cross", "norm_ff"] {
            self.norm(name, rows);
        }
    }

    /// Adds the norm and the projection that decode images at the end of a renderer.
    pub fn output_head(&mut self) {
        self.enter(Part::Renderer, None, "renderer");
        self.norm("output_norm", TARGETS);
        self.linear("to_pixels", [self.config.dim, self.config.rgb_patch_len()], TARGETS, false);
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
