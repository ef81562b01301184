//! The encoder-decoder of LVSM (arXiv 2410.17242), a baseline: learned latents are encoded beside the patches of the context
//! views by self-attention, and decoded beside the patches of a target view by self-attention.
// B scenes, T target views, N patches of all context views, L latents, Q patches of a view, D width

use burn::module::{Module, Param};
use burn::nn::LayerNorm;
use burn::tensor::Tensor;

use crate::network::blocks::block::EncoderBlock;
use crate::network::config::ModelConfig;
use crate::network::init::Init;

#[derive(Module, Debug)]
pub struct Latents {
    /// `[1, L, D]`
    weight: Param<Tensor<3>>,
}

impl Latents {
    pub(crate) fn new(config: &ModelConfig, init: &mut Init) -> Self {
        Self { weight: init.latents(config.num_latents, config.dim) }
    }

    /// Joins latents and patches of every scene, `[B, N, D] -> [B, L + N, D]`.
    pub(crate) fn join(&self, patches: Tensor<3>) -> Tensor<3> {
        let ([batch, ..], [_, count, dim]) = (patches.dims(), self.weight.dims());
        Tensor::cat(vec![self.weight.val().expand([batch, count, dim]), patches], 1)
    }
}

/// A norm and self-attention blocks over `[patches; latents]`.
#[derive(Module, Debug)]
pub struct JointDecoder {
    input_norm: LayerNorm,
    blocks: Vec<EncoderBlock>,
}

impl JointDecoder {
    pub(crate) fn new(config: &ModelConfig, init: &mut Init) -> Self {
        Self {
            input_norm: init.layer_norm(config.dim),
            blocks: (0..config.num_renderer_blocks).map(|i| EncoderBlock::new(config, init.block(Some(i)))).collect(),
        }
    }

    /// Joins the patches of every view with the latents of its scene, and applies norm and blocks.
    ///
    /// # Shapes
    /// - `patches` and the result: `[batch * views, num_queries, dim]`
    /// - `latents`: `[batch, num_latents, dim]`, or one set per view
    pub(crate) fn forward(&self, patches: Tensor<3>, latents: Tensor<3>) -> Tensor<3> {
        let ([views, num_queries, _], [groups, count, dim]) = (patches.dims(), latents.dims());
        let of_views = latents.unsqueeze_dim::<4>(1).expand([groups, views / groups, count, dim]);
        let joined = Tensor::cat(vec![patches, of_views.reshape([views, count, dim])], 1);
        forward_blocks(&self.blocks, self.input_norm.forward(joined), num_queries)
    }
}

/// Applies blocks to `x: [batch, rows, dim]`; the last one returns the first `count` rows: nothing reads the others.
pub(crate) fn forward_blocks(blocks: &[EncoderBlock], x: Tensor<3>, count: usize) -> Tensor<3> {
    blocks.iter().enumerate().fold(x, |x, (index, block)| {
        let is_last = index + 1 == blocks.len();
        if is_last { block.forward_first(x, count) } else { block.forward(x, None) }
    })
}
