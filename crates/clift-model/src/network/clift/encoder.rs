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
    config: ModelConfig,
    #[module(skip)]
    transforms: TransformMaker,
}

impl PatchEncoder {
    /// Makes an encoder of the sizes of `config`.
    pub fn new(config: &ModelConfig, init: &mut Init) -> Self {
        Self {
            patch_embed: init.linear(config.context_patch_len(), config.dim),
            blocks: (0..config.num_encoder_blocks).map(|_| EncoderBlock::new(config, init)).collect(),
            config: config.clone(),
            transforms: TransformMaker::new(config),
        }
    }

    /// Returns the number of groups of views of all scenes.
    fn num_groups(&self, context: &Cameras) -> usize {
        let [batch, views] = context.dims();
        batch * self.config.num_groups(views)
    }
}

impl EncoderBlocks for PatchEncoder {
    fn transforms(&self, context: &Cameras) -> Option<TokenTransforms> {
        self.transforms.of_views(context).map(|transforms| transforms.regroup(self.num_groups(context)))
    }

    fn embed(&self, context: &Views) -> Tensor<3> {
        let Views { images, cameras } = context;
        let x = embed_context(&self.patch_embed, images.clone(), cameras, self.config.patch_size, self.config.rays);
        let ([batch, count, dim], groups) = (x.dims(), self.num_groups(cameras));
        x.reshape([groups, batch * count / groups, dim])
    }

    fn num_blocks(&self) -> usize {
        self.blocks.len()
    }

    fn block(&self, index: usize, x: Tensor<3>, transforms: Option<&TokenTransforms>) -> Tensor<3> {
        self.blocks[index].forward(x, transforms)
    }
}
