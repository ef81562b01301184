//! The pre-norm transformer blocks of the encoder and the renderer (paper sections 3.1, 3.3).
// B scenes, N tokens, T target views, G groups of views with the same tokens, Q queries, D width

use burn::module::Module;
use burn::nn::LayerNorm;
use burn::tensor::Tensor;

use crate::network::blocks::attention::{CrossAttention, SelfAttention};
use crate::network::blocks::feed_forward::{Activation, FeedForward};
use crate::network::config::ModelConfig;
use crate::network::init::Init;
use crate::network::tokens::Tokens;
use crate::ops::attention::cross_sdpa;

/// Self-attention and feed-forward network, each with a norm before and a residual connection.
#[derive(Module, Debug)]
pub struct EncoderBlock {
    norm_attn: LayerNorm,
    attn: SelfAttention,
    norm_ff: LayerNorm,
    feed_forward: FeedForward,
}

impl EncoderBlock {
    pub fn new(config: &ModelConfig, init: &mut Init) -> Self {
        Self {
            norm_attn: init.layer_norm(config.dim),
            attn: SelfAttention::new(config, init),
            norm_ff: init.layer_norm(config.dim),
            feed_forward: FeedForward::new(Activation::Gelu, config.dim, config.feed_forward_dim, init),
        }
    }

    pub fn forward(&self, x: Tensor<3>, transforms: Option<&Tensor<3>>) -> Tensor<3> {
        let x = x.clone() + self.attn.forward(&self.norm_attn, x, transforms);
        x.clone() + self.feed_forward.forward(&self.norm_ff, x)
    }

    /// Updates the first `count` tokens of a scene, for a last block whose other tokens nothing reads.
    ///
    /// # Shapes
    /// - `x`: `[batch, num_tokens, dim]`
    /// - returns `[batch, count, dim]`, the first rows of [`forward`](Self::forward)
    pub fn forward_first(&self, x: Tensor<3>, count: usize) -> Tensor<3> {
        let first = x.clone().narrow(1, 0, count);
        let first = first + self.attn.forward_first(&self.norm_attn, x, count);
        first.clone() + self.feed_forward.forward(&self.norm_ff, first)
    }
}

/// Self-attention among the patches of a target view, cross-attention to the scene's tokens and feed-forward network, each
/// with a norm before and a residual connection. The scene's tokens have no norm.
#[derive(Module, Debug)]
pub struct DecoderBlock {
    norm_self: LayerNorm,
    self_attn: SelfAttention,
    norm_cross: LayerNorm,
    cross_attn: CrossAttention,
    norm_ff: LayerNorm,
    feed_forward: FeedForward,
}

impl DecoderBlock {
    pub fn new(config: &ModelConfig, init: &mut Init) -> Self {
        Self {
            norm_self: init.layer_norm(config.dim),
            self_attn: SelfAttention::new(config, init),
            norm_cross: init.layer_norm(config.dim),
            cross_attn: CrossAttention::new(config, init),
            norm_ff: init.layer_norm(config.dim),
            feed_forward: FeedForward::new(Activation::Gelu, config.dim, config.feed_forward_dim, init),
        }
    }

    /// Projects a scene's tokens to the keys and values of cross-attention, which are the same for all views.
    ///
    /// # Shapes
    /// - `tokens`: `[groups, num_render_tokens, dim]`
    /// - returns `[groups, num_render_tokens, 2 dim]`, keys and values side by side
    pub fn project_tokens(&self, tokens: Tokens) -> Tensor<3> {
        self.cross_attn.project_key_value(None, tokens)
    }

    /// Updates the patches of target views from the keys and values of [`project_tokens`](Self::project_tokens). The views
    /// of a group are consecutive and share its keys and values; they do not attend to each other.
    ///
    /// # Shapes
    /// - `x` and the result: `[views, num_queries, dim]`
    /// - `key_value`: `[groups, num_render_tokens, 2 dim]`
    pub fn forward(&self, x: Tensor<3>, key_value: Tensor<3>, transforms: Option<&Tensor<3>>) -> Tensor<3> {
        let [views, num_queries, dim] = x.dims();
        let [groups, _, _] = key_value.dims();
        let x = x.clone() + self.self_attn.forward(&self.norm_self, x, transforms);

        // Queries are independent of each other, so that the views of a group form one sequence of queries.
        let query = self.cross_attn.project_query(Some(&self.norm_cross), x.clone(), transforms);
        let query = query.reshape([groups, views / groups * num_queries, dim]); // [T, Q, D] -> [G, TQ / G, D]
        let attended = cross_sdpa(query, key_value, self.cross_attn.num_heads()).reshape([views, num_queries, dim]);
        let x = x + self.cross_attn.project_out(attended, transforms);

        x.clone() + self.feed_forward.forward(&self.norm_ff, x)
    }
}
