//! The multi-view encoder: context views to light-field tokens (paper section 3.1).
// B scenes, V views, N tokens, D width

use burn::module::Module;
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
    patch_embed: Linear,
    blocks: Vec<EncoderBlock>,
    #[module(skip)]
    patch_size: usize,
    #[module(skip)]
    transforms: TransformMaker,
}

impl Encoder {
    /// Makes an encoder of the sizes of `config`.
    pub fn new(config: &ModelConfig, init: &mut Init) -> Self {
        Self {
            patch_embed: init.linear(config.context_patch_len(), config.dim),
            blocks: (0..config.num_encoder_blocks).map(|_| EncoderBlock::new(config, init)).collect(),
            patch_size: config.patch_size,
            transforms: TransformMaker::new(config),
        }
    }

    /// Encodes context views into light-field tokens, one per patch.
    ///
    /// # Shapes
    /// - returns `[batch, views * (height / patch) * (width / patch), dim]`, ordered by view, row, column
    pub fn forward(&self, context: &Views) -> Tokens {
        let transforms = self.transforms(&context.cameras);
        let x = self.blocks.iter().fold(self.embed(context), |x, block| block.forward(x, transforms.as_ref()));
        Tokens { values: self.to_tokens(x), transforms }
    }

    /// Makes the transforms of the tokens for camera-relative attention; `None` without it.
    pub fn transforms(&self, context: &Cameras) -> Option<TokenTransforms> {
        self.transforms.of_views(context)
    }

    /// Embeds patches and rays: the input of the first block, `[batch, rows, dim]`.
    pub fn embed(&self, context: &Views) -> Tensor<3> {
        let pixels = Tensor::cat(vec![context.images.clone(), plucker(&context.cameras)], 4); // [B, V, H, W, 9]
        linear_in_f32(&self.patch_embed, patchify(pixels, self.patch_size))
    }

    /// Returns the blocks after [`embed`](Self::embed).
    pub fn blocks(&self) -> &[EncoderBlock] {
        &self.blocks
    }

    /// Returns the tokens of a scene, given the output of the last block.
    ///
    /// # Shapes
    /// - `x`: `[batch, rows, dim]`, as [`embed`](Self::embed) returns
    /// - returns `[batch, num_tokens, dim]`
    pub fn to_tokens(&self, x: Tensor<3>) -> Tensor<3> {
        x
    }
}
