//! The pre-norm transformer blocks of the encoder and the renderer (paper sections 3.1, 3.3).
// B scenes, N tokens, T target views, G groups of views with the same tokens, Q queries, D width

use burn::module::Module;
use burn::nn::LayerNorm;
use burn::tensor::Tensor;

use crate::network::blocks::attention::{CrossAttention, SelfAttention};
use crate::network::blocks::feed_forward::FeedForward;
use crate::network::camera_encoding::TokenTransforms;
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
    pub fn forward(&self, x: Tensor<3>, transforms: Option<&TokenTransforms>) -> Tensor<3> {
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
    pub fn project_tokens(&self, tokens: Tokens) -> Tensor<3> {
        self.cross_attn.project_key_value(None, tokens)
    }

    /// Updates the patches of target views from the keys and values of [`project_tokens`](Self::project_tokens). The views
    /// of a group are consecutive and share its keys and values; they do not attend to each other.
    ///
    /// # Shapes
    /// - `x` and the result: `[views, num_queries, dim]`
    /// - `key_value`: `[groups, num_render_tokens, 2 dim]`
    pub fn forward(&self, x: Tensor<3>, key_value: Tensor<3>, transforms: Option<&TokenTransforms>) -> Tensor<3> {
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::network::architecture::CliftVariant;
    use crate::network::init::LayerStyle;
    use crate::testing::{
        Fixture, assert_close, devices, load_weights, output_and_gradients, random, small_lvsm, to_f64,
        weight_gradients,
    };

    /// Expects output and gradients of a block of width 16 in f32 to equal those of PyTorch in f64.
    fn assert_equals_pytorch<M: Module>(
        name: &str,
        input_names: &[&str],
        new: fn(&ModelConfig, &mut Init) -> M,
        forward: fn(&M, &[Tensor<3>]) -> Tensor<3>,
    ) {
        let config = ModelConfig { dim: 16, num_heads: 4, feed_forward_dim: 24, ..ModelConfig::default() };
        let fixture = Fixture::open(name);
        for device in devices() {
            let device = device.autodiff();
            let tensor = |name: &str| fixture.tensor::<3>(name, &device);
            let block = load_weights(new(&config, &mut Init::new(0, &device)), &fixture, "weight.");
            let inputs = input_names.iter().map(|name| tensor(&format!("input.{name}")).require_grad());
            let inputs: Vec<Tensor<3>> = inputs.collect();
            let output = forward(&block, &inputs);
            assert_close(&output.clone().inner(), &tensor("output.x").inner(), 5e-6);
            let grads = (output * tensor("input.cotangent")).sum().backward();
            for (name, input) in input_names.iter().zip(inputs) {
                let expected = tensor(&format!("grad.input.{name}")).inner();
                assert_close(&input.grad(&grads).expect("tracked"), &expected, 2e-5);
            }
            weight_gradients(&block, &grads, &fixture, "grad.weight.", 2e-5);
        }
    }

    #[test]
    fn blocks_equal_pytorch_with_gradients() {
        assert_equals_pytorch("encoder_block", &["x"], EncoderBlock::new, |block, inputs| {
            block.forward(inputs[0].clone(), None)
        });
        assert_equals_pytorch("decoder_block", &["x", "memory"], DecoderBlock::new, |block, inputs| {
            block.forward(inputs[0].clone(), block.project_tokens(Tokens::without_cameras(inputs[1].clone())), None)
        });
    }

    #[test]
    fn first_rows_equal_those_of_the_whole_block() {
        for variant in [CliftVariant::Paper, CliftVariant::ReleasedRe10k] {
            for device in devices() {
                let config = small_lvsm(variant);
                let style = LayerStyle { has_query_key_norms: !variant.is_released(), ..LayerStyle::PYTORCH };
                let block = to_f64(EncoderBlock::new(&config, &mut Init::with_style(style, 3, &device))).train();
                let [x, cotangent] = [(5, 1), (3, 2)].map(|(rows, seed)| random([2, rows, config.dim], seed, &device));
                let both = |f: &dyn Fn(Tensor<3>) -> Tensor<3>| {
                    output_and_gradients([x.clone()], cotangent.clone(), |[x]| f(x))
                };
                let (output, [grad]) = both(&|x| block.forward_first(x, 3));
                let (expected, [expected_grad]) = both(&|x| block.forward(x, None).narrow(1, 0, 3));
                assert_close(&output, &expected, 1e-12);
                assert_close(&grad, &expected_grad, 1e-12);
            }
        }
    }
}
