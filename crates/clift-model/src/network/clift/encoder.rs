//! The multi-view encoder: context views to light-field tokens (paper section 3.1).

use burn::module::Module;
use burn::nn::Linear;
use burn::tensor::Tensor;

use crate::network::blocks::block::EncoderBlock;
use crate::network::blocks::pixels::embed_context;
use crate::network::camera_encoding::{TokenTransforms, TransformMaker};
use crate::network::config::ModelConfig;
use crate::network::design::EncoderBlocks;
use crate::network::init::Init;
use crate::views::upload::{Cameras, Views};

/// Patch embedding and self-attention over the tokens of all views.
#[derive(Module, Debug)]
pub struct PatchEncoder {
    patch_embed: Linear,
    blocks: Vec<EncoderBlock>,
    #[module(skip)]
    patch_size: usize,
    #[module(skip)]
    transforms: TransformMaker,
}

impl PatchEncoder {
    /// Makes an encoder of the sizes of `config`.
    pub fn new(config: &ModelConfig, init: &mut Init) -> Self {
        Self {
            patch_embed: init.linear(config.context_patch_len(), config.dim),
            blocks: (0..config.num_encoder_blocks).map(|_| EncoderBlock::new(config, init)).collect(),
            patch_size: config.patch_size,
            transforms: TransformMaker::new(config),
        }
    }
}

impl EncoderBlocks for PatchEncoder {
    fn transforms(&self, context: &Cameras) -> Option<TokenTransforms> {
        self.transforms.of_views(context)
    }

    fn embed(&self, context: &Views) -> Tensor<3> {
        embed_context(&self.patch_embed, context.images.clone(), &context.cameras, self.patch_size)
    }

    fn num_blocks(&self) -> usize {
        self.blocks.len()
    }

    fn block(&self, index: usize, x: Tensor<3>, transforms: Option<&TokenTransforms>) -> Tensor<3> {
        self.blocks[index].forward(x, transforms)
    }
}
