//! The multi-view encoder: context views to tokens (paper section 3.1).
// B scenes, V views, H rows, W columns

use burn::module::Module;
use burn::nn::Linear;
use burn::tensor::Tensor;

use crate::network::architecture::Architecture;
use crate::network::blocks::block::EncoderBlock;
use crate::network::camera_encoding::transforms;
use crate::network::config::ModelConfig;
use crate::network::init::Init;
use crate::network::lvsm_ed::{Latents, forward_blocks};
use crate::network::tokens::Tokens;
use crate::ops::linear::linear_in_f32;
use crate::views::patch::patchify;
use crate::views::rays::rays;
use crate::views::upload::Views;

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
        let ModelConfig { patch_size, rays: frame, num_latents, .. } = self.config;
        let transforms = transforms(&self.config, &context.cameras);
        let colors = context.images.clone();
        let colors = if self.latents.is_some() { colors * 2.0 - 1.0 } else { colors };
        let pixels = Tensor::cat(vec![colors, rays(&context.cameras, frame)], 4); // [B, V, H, W, 6 or 9]
        let x = linear_in_f32(&self.patch_embed, patchify(pixels, patch_size));
        let values = match &self.latents {
            Some(latents) => forward_blocks(&self.blocks, latents.join(x), num_latents),
            None => self.blocks.iter().fold(x, |x, block| block.forward(x, transforms.as_ref())),
        };
        Tokens { values, transforms }
    }
}
