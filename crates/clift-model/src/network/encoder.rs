//! The multi-view encoder: context views to light-field tokens (paper section 3.1).
// B scenes, V views, N patches, L latents, D width

use burn::module::{Module, Param};
use burn::nn::Linear;
use burn::tensor::Tensor;

use crate::network::blocks::block::EncoderBlock;
use crate::network::camera_encoding::{TokenTransforms, TransformMaker};
use crate::network::config::ModelConfig;
use crate::network::init::Init;
use crate::network::tokens::Tokens;
use crate::ops::linear::linear_in_f32;
use crate::views::patch::patchify;
use crate::views::rays::plucker;
use crate::views::upload::{Cameras, Views};

/// Patch embedding and self-attention over the tokens of all views. The result is the residual stream without a norm;
/// one variant applies a [`LiftNorm`](crate::LiftNorm) to it.
#[derive(Module, Debug)]
pub struct Encoder {
    /// Learned tokens `[1, L, D]` of LVSM, which are encoded beside the patches.
    latents: Option<Latents>,
    patch_embed: Linear,
    blocks: Vec<EncoderBlock>,
    #[module(skip)]
    has_signed_colors: bool,
    #[module(skip)]
    patch_size: usize,
    #[module(skip)]
    transforms: TransformMaker,
}

/// Learned tokens.
#[derive(Module, Debug)]
struct Latents {
    /// `[1, L, D]`
    weight: Param<Tensor<3>>,
}

impl Encoder {
    /// Makes an encoder of the sizes of `config`.
    pub fn new(config: &ModelConfig, init: &mut Init) -> Self {
        Self {
            latents: config.has_latents().then(|| Latents { weight: init.latents(config.num_latents, config.dim) }),
            patch_embed: init.block(None).linear(config.context_patch_len(), config.dim),
            blocks: (0..config.num_encoder_blocks).map(|i| EncoderBlock::new(config, init.block(Some(i)))).collect(),
            has_signed_colors: config.has_signed_colors(),
            patch_size: config.patch_size,
            transforms: TransformMaker::new(config),
        }
    }

    /// Encodes context views into light-field tokens, one per patch, or into the latents.
    ///
    /// # Shapes
    /// - returns `[batch, views * (height / patch) * (width / patch), dim]`, ordered by view, row, column; or
    ///   `[batch, num_latents, dim]`
    pub fn forward(&self, context: &Views) -> Tokens {
        let transforms = self.transforms(&context.cameras);
        let forward = |x, block| self.block(block, x, transforms.as_ref());
        Tokens { values: (0..self.num_blocks()).fold(self.embed(context), forward), transforms }
    }

    /// Makes the transforms of the tokens for camera-relative attention; `None` without it.
    pub fn transforms(&self, context: &Cameras) -> Option<TokenTransforms> {
        self.transforms.of_views(context)
    }

    /// Embeds patches and rays, after the latents if there are some: the input of the first block, `[batch, rows, dim]`.
    pub fn embed(&self, context: &Views) -> Tensor<3> {
        let colors = context.images.clone();
        let colors = if self.has_signed_colors { colors * 2.0 - 1.0 } else { colors };
        let pixels = Tensor::cat(vec![colors, plucker(&context.cameras)], 4); // [B, V, H, W, 9]
        let patches = linear_in_f32(&self.patch_embed, patchify(pixels, self.patch_size));
        let Some(Latents { weight }) = &self.latents else { return patches };
        let ([batch, ..], [_, count, dim]) = (patches.dims(), weight.dims());
        Tensor::cat(vec![weight.val().expand([batch, count, dim]), patches], 1) // [B, L + N, D]
    }

    /// Returns the number of blocks after [`embed`](Self::embed).
    pub fn num_blocks(&self) -> usize {
        self.blocks.len()
    }

    /// Applies a block. The last one returns the tokens of the scene: beside latents, the patches are dropped.
    ///
    /// # Shapes
    /// - `x`: `[batch, rows, dim]`, as [`embed`](Self::embed) returns
    /// - returns the same, or `[batch, num_tokens, dim]` from the last block
    pub fn block(&self, block: usize, x: Tensor<3>, transforms: Option<&TokenTransforms>) -> Tensor<3> {
        match &self.latents {
            Some(Latents { weight }) if block + 1 == self.blocks.len() => {
                self.blocks[block].forward_first(x, weight.dims()[1])
            }
            _ => self.blocks[block].forward(x, transforms),
        }
    }
}
