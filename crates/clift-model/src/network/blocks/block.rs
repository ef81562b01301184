//! The pre-norm transformer blocks of the encoder and the renderer (paper sections 3.1, 3.3).
// B scenes, N tokens, T target views, G groups of views with the same tokens, Q queries, D width

use burn::module::Module;
use burn::nn::LayerNorm;
use burn::tensor::Tensor;

use crate::network::blocks::attention::{CrossAttention, SelfAttention};
use crate::network::blocks::feed_forward::FeedForward;
use crate::network::config::ModelConfig;
use crate::network::init::Init;
use crate::ops::attention::sdpa::cross_sdpa;

/// Self-attention and feed-forward network, each with a norm before and a residual connection.
#[derive(Module, Debug)]
pub struct EncoderBlock {
    norm_attn: LayerNorm,
    attn: SelfAttention,
    norm_ff: LayerNorm,
    feed_forward: FeedForward,
}

impl EncoderBlock {
    /// Makes a block of the sizes of `config`.
    pub fn new(config: &ModelConfig, init: &mut Init) -> Self {
        Self {
            norm_attn: init.layer_norm(config.dim),
            attn: SelfAttention::new(config, init),
            norm_ff: init.layer_norm(config.dim),
            feed_forward: FeedForward::new(config.dim, config.feed_forward_dim, init),
        }
    }

    /// Updates the tokens of a scene.
    ///
    /// # Shapes
    /// - `x` and the result: `[batch, num_tokens, dim]`
    pub fn forward(&self, x: Tensor<3>) -> Tensor<3> {
        let x = x.clone() + self.attn.forward(&self.norm_attn, x);
        x.clone() + self.feed_forward.forward(&self.norm_ff, x)
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
    /// Makes a block of the sizes of `config`.
    pub fn new(config: &ModelConfig, init: &mut Init) -> Self {
        Self {
            norm_self: init.layer_norm(config.dim),
            self_attn: SelfAttention::new(config, init),
            norm_cross: init.layer_norm(config.dim),
            cross_attn: CrossAttention::new(config, init),
            norm_ff: init.layer_norm(config.dim),
            feed_forward: FeedForward::new(config.dim, config.feed_forward_dim, init),
        }
    }

    /// Projects a scene's tokens to the keys and values of cross-attention, which are the same for all views.
    ///
    /// # Shapes
    /// - `tokens`: `[groups, num_render_tokens, dim]`
    /// - returns `[groups, num_render_tokens, 2 dim]`, keys and values side by side
    pub fn project_tokens(&self, tokens: Tensor<3>) -> Tensor<3> {
        self.cross_attn.project_key_value(None, tokens)
    }

    /// Updates the patches of target views from the keys and values of [`project_tokens`](Self::project_tokens). The views
    /// of a group are consecutive and share its keys and values; they do not attend to each other.
    ///
    /// # Shapes
    /// - `x` and the result: `[views, num_queries, dim]`
    /// - `key_value`: `[groups, num_render_tokens, 2 dim]`
    pub fn forward(&self, x: Tensor<3>, key_value: Tensor<3>) -> Tensor<3> {
        let [views, num_queries, dim] = x.dims();
        let [groups, _, _] = key_value.dims();
        let x = x.clone() + self.self_attn.forward(&self.norm_self, x);

        // Queries are independent of each other, so that the views of a group form one sequence of queries.
        let query = self.cross_attn.project_query(Some(&self.norm_cross), x.clone());
        let query = query.reshape([groups, views / groups * num_queries, dim]); // [T, Q, D] -> [G, TQ / G, D]
        let attended = cross_sdpa(query, key_value, self.cross_attn.num_heads()).reshape([views, num_queries, dim]);
        let x = x + self.cross_attn.project_out(attended);

        x.clone() + self.feed_forward.forward(&self.norm_ff, x)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{Fixture, assert_close, devices, load_weights, weight_gradients};

    fn config() -> ModelConfig {
        ModelConfig { dim: 16, num_heads: 4, feed_forward_dim: 24, ..ModelConfig::default() }
    }

    // A block of width 16 in f32 against f64.
    const OUTPUT: f64 = 5e-6;
    const GRADIENT: f64 = 2e-5;

    #[test]
    fn encoder_block_equals_pytorchs_with_gradients() {
        let fixture = Fixture::open("encoder_block");
        for device in devices() {
            let device = device.autodiff();
            let block = load_weights(EncoderBlock::new(&config(), &mut Init::new(0, &device)), &fixture, "weight.");
            let x = fixture.tensor::<3>("input.x", &device).require_grad();
            let output = block.forward(x.clone());
            assert_close(&output.clone().inner(), &fixture.tensor::<3>("output.x", &device).inner(), OUTPUT);
            let grads = (output * fixture.tensor("input.cotangent", &device)).sum().backward();
            let expected = fixture.tensor::<3>("grad.input.x", &device).inner();
            assert_close(&x.grad(&grads).expect("tracked"), &expected, GRADIENT);
            weight_gradients(&block, &grads, &fixture, "grad.weight.", GRADIENT);
        }
    }

    #[test]
    fn decoder_block_equals_pytorchs_with_gradients() {
        let fixture = Fixture::open("decoder_block");
        for device in devices() {
            let device = device.autodiff();
            let block = load_weights(DecoderBlock::new(&config(), &mut Init::new(0, &device)), &fixture, "weight.");
            let x = fixture.tensor::<3>("input.x", &device).require_grad();
            let memory = fixture.tensor::<3>("input.memory", &device).require_grad();
            let output = block.forward(x.clone(), block.project_tokens(memory.clone()));
            assert_close(&output.clone().inner(), &fixture.tensor::<3>("output.x", &device).inner(), OUTPUT);
            let grads = (output * fixture.tensor("input.cotangent", &device)).sum().backward();
            for (name, input) in [("x", x), ("memory", memory)] {
                let expected = fixture.tensor::<3>(&format!("grad.input.{name}"), &device).inner();
                assert_close(&input.grad(&grads).expect("tracked"), &expected, GRADIENT);
            }
            weight_gradients(&block, &grads, &fixture, "grad.weight.", GRADIENT);
        }
    }
}
