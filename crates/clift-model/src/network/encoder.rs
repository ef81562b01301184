//! The multi-view encoder: context views to tokens (paper section 3.1).

use burn::module::Module;
use burn::nn::Linear;
use burn::tensor::Tensor;

use crate::network::architecture::Architecture;
use crate::network::blocks::block::EncoderBlock;
use crate::network::blocks::pixels::embed_context;
use crate::network::camera_encoding::transforms;
use crate::network::config::ModelConfig;
use crate::network::init::Init;
use crate::network::lvsm_ed::Latents;
use crate::network::tokens::Tokens;
use crate::views::upload::{Cameras, Views};

/// Patch embedding and self-attention over the tokens of all views, as a list of blocks on the residual stream. Its result
/// has no norm; one variant applies a norm to it.
#[derive(Module, Debug)]
pub struct Encoder {
    /// Of LVSM, whose tokens are these after the last block.
    latents: Option<Latents>,
    patch_embed: Linear,
    blocks: Vec<EncoderBlock>,
    #[module(skip)]
    config: ModelConfig,
}

impl Encoder {
    /// Makes an encoder of the sizes of `config`.
    pub fn new(config: &ModelConfig, init: &mut Init) -> Self {
        Self {
            latents: (config.architecture == Architecture::LvsmEd).then(|| Latents::new(config, init)),
            patch_embed: init.block(None).linear(config.context_patch_len(), config.dim),
            blocks: (0..config.num_encoder_blocks).map(|i| EncoderBlock::new(config, init.block(Some(i)))).collect(),
            config: config.clone(),
        }
    }

    /// Encodes context views into tokens.
    ///
    /// # Shapes
    /// - returns `[batch, num_tokens, dim]`; tokens of patches are ordered by view, row, column
    pub fn forward(&self, context: &Views) -> Tokens {
        let transforms = self.transforms(&context.cameras);
        let forward = |x, index| self.block(index, x, transforms.as_ref());
        let values = (0..self.num_blocks()).fold(self.embed(context), forward);
        Tokens { values, transforms }
    }

    /// Makes the transforms of the tokens for camera-relative attention; `None` without it.
    pub(crate) fn transforms(&self, context: &Cameras) -> Option<Tensor<3>> {
        transforms(&self.config, context)
    }

    /// Makes the input of the first block, `[batch, rows, dim]`.
    pub(crate) fn embed(&self, context: &Views) -> Tensor<3> {
        let ModelConfig { patch_size, rays, .. } = self.config;
        let colors = context.images.clone();
        let colors = if self.latents.is_some() { colors * 2.0 - 1.0 } else { colors };
        let x = embed_context(&self.patch_embed, colors, &context.cameras, patch_size, rays);
        match &self.latents {
            Some(latents) => latents.join(x),
            None => x,
        }
    }

    pub(crate) fn num_blocks(&self) -> usize {
        self.blocks.len()
    }

    /// Applies a block; the last one returns the tokens, `[batch, num_tokens, dim]`.
    pub(crate) fn block(&self, index: usize, x: Tensor<3>, transforms: Option<&Tensor<3>>) -> Tensor<3> {
        if self.latents.is_some() && index + 1 == self.blocks.len() {
            return self.blocks[index].forward_first(x, self.config.num_latents);
        }
        self.blocks[index].forward(x, transforms)
    }
}
