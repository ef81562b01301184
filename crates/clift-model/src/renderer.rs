//! The neural renderer: tokens and a camera to a picture (paper section 3.3).
// B scenes, T target views, Q patches of a view, R render tokens, D width

use burn::module::Module;
use burn::nn::{LayerNorm, Linear};
use burn::tensor::{Tensor, activation::sigmoid};

use crate::block::DecoderBlock;
use crate::linear::{linear, linear_of_norm};
use crate::patch::{patchify, unpatchify};
use crate::rays::plucker;
use crate::{Cameras, Init, ModelConfig};

/// A transformer decoder whose queries are the target's ray patches.
#[derive(Module, Debug)]
pub struct Renderer {
    ray_embed: Linear,
    blocks: Vec<DecoderBlock>,
    output_norm: LayerNorm,
    to_pixels: Linear,
    #[module(skip)]
    patch_size: usize,
}

impl Renderer {
    /// Makes a renderer of the sizes of `config`.
    pub fn new(config: &ModelConfig, init: &mut Init) -> Self {
        Self {
            ray_embed: init.linear(config.ray_patch_len(), config.dim),
            blocks: (0..config.num_renderer_blocks).map(|_| DecoderBlock::new(config, init)).collect(),
            output_norm: init.layer_norm(config.dim),
            to_pixels: init.linear(config.dim, config.rgb_patch_len()),
            patch_size: config.patch_size,
        }
    }

    /// Draws target views from tokens. Views are independent of each other.
    ///
    /// Tokens may be one set per scene (`groups = batch`), shared by all its target views, or one set
    /// per target view (`groups = batch * views`, views of a scene consecutive).
    ///
    /// # Shapes
    /// - `tokens`: `[groups, num_render_tokens, dim]`
    /// - returns RGB in `(0, 1)`, `[batch, views, height, width, 3]`
    pub fn forward(&self, tokens: Tensor<3>, targets: &Cameras) -> Tensor<5> {
        let [batch, views] = targets.dims();
        let [groups, _, dim] = tokens.dims();
        assert!(groups == batch || groups == batch * views, "{groups} token sets for {batch} scenes of {views} views");
        let rays = linear(&self.ray_embed, patchify(plucker(targets), self.patch_size)); // [B, TQ, D]
        let num_queries = rays.dims()[1] / views;
        let x = rays.reshape([batch * views, num_queries, dim]);
        let x = self.blocks.iter().fold(x, |x, block| block.forward(x, tokens.clone())); // [BT, Q, D]
        let patches = sigmoid(linear_of_norm(&self.output_norm, &self.to_pixels, x));
        let values = patches.dims()[2];
        let patches = patches.reshape([batch, views * num_queries, values]);
        unpatchify(patches, [views, targets.height, targets.width], self.patch_size)
    }
}
