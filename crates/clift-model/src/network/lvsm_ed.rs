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

    pub(crate) fn num_blocks(&self) -> usize {
        self.blocks.len()
    }

    /// Joins the patches of every view with the latents of its scene: the input of the first block.
    ///
    /// # Shapes
    /// - `patches`: `[batch * views, num_queries, dim]`
    /// - `latents`: `[batch, num_latents, dim]`, or one set per view
    /// - returns `[batch * views, num_queries + num_latents, dim]`
    pub(crate) fn join(&self, patches: Tensor<3>, latents: Tensor<3>) -> Tensor<3> {
        let ([views, ..], [groups, count, dim]) = (patches.dims(), latents.dims());
        let of_views = latents.unsqueeze_dim::<4>(1).expand([groups, views / groups, count, dim]);
        self.input_norm.forward(Tensor::cat(vec![patches, of_views.reshape([views, count, dim])], 1))
    }

    /// Applies a block. The last one returns the patches alone.
    ///
    /// # Shapes
    /// - `x`: `[batch * views, num_queries + num_latents, dim]`
    /// - returns the same, or `[batch * views, num_queries, dim]` from the last block
    pub(crate) fn block(&self, block: usize, x: Tensor<3>, num_latents: usize) -> Tensor<3> {
        let [_, rows, _] = x.dims();
        if block + 1 == self.blocks.len() {
            self.blocks[block].forward_first(x, rows - num_latents)
        } else {
            self.blocks[block].forward(x, None)
        }
    }
}
