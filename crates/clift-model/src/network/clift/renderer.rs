//! The cross-attention renderer: ray patches of a target view read the tokens (paper section 3.3).

use burn::module::Module;
use burn::nn::{LayerNorm, Linear};
use burn::tensor::Tensor;

use crate::network::blocks::block::DecoderBlock;
use crate::network::blocks::pixels::{decode_image, embed_rays};
use crate::network::camera_encoding::{TokenTransforms, TransformMaker};
use crate::network::config::ModelConfig;
use crate::network::design::{Patches, RendererBlocks};
use crate::network::init::Init;
use crate::network::render_tokens::{KeyValueCache, RenderTokens};
use crate::views::patch_grids::PatchGrids;
use crate::views::rays::RayFrame;
use crate::views::upload::Cameras;

/// A transformer decoder whose queries are the ray patches of a target view.
#[derive(Module, Debug)]
pub struct CrossRenderer {
    ray_embed: Linear,
    blocks: Vec<DecoderBlock>,
    output_norm: LayerNorm,
    to_pixels: Linear,
    #[module(skip)]
    patches: Patches,
    #[module(skip)]
    rays: RayFrame,
    #[module(skip)]
    transforms: TransformMaker,
}

impl CrossRenderer {
    /// Makes a renderer of the sizes of `config`.
    pub fn new(config: &ModelConfig, init: &mut Init) -> Self {
        Self {
            ray_embed: init.linear(config.ray_patch_len(), config.dim),
            blocks: (0..config.num_renderer_blocks).map(|_| DecoderBlock::new(config, init)).collect(),
            output_norm: init.layer_norm(config.dim),
            to_pixels: init.linear(config.dim, config.rgb_patch_len()),
            patches: Patches::new(config),
            rays: config.rays,
            transforms: TransformMaker::new(config),
        }
    }
}

impl RendererBlocks for CrossRenderer {
    fn patches(&self) -> Patches {
        self.patches
    }

    fn set_patch_grids(&mut self, patch_grids: PatchGrids) {
        self.patches.grids = patch_grids;
    }

    fn is_camera_relative(&self) -> bool {
        self.transforms.is_camera_relative()
    }

    fn transforms(&self, targets: &Cameras) -> Option<TokenTransforms> {
        let [batch, views] = targets.dims();
        self.transforms.of_views(targets).map(|transforms| transforms.regroup(batch * views))
    }

    /// Projects the tokens to keys and values in every block.
    fn cache(&self, tokens: RenderTokens) -> KeyValueCache {
        let blocks = self.blocks.iter().map(|block| tokens.project(block)).collect();
        KeyValueCache::Projected { blocks, num_tokens: tokens.num_tokens() }
    }

    fn embed(&self, _tokens: &KeyValueCache, targets: &Cameras) -> Tensor<3> {
        embed_rays(&self.ray_embed, targets, self.patches.size, self.rays)
    }

    fn num_blocks(&self) -> usize {
        self.blocks.len()
    }

    fn block(
        &self,
        index: usize,
        x: Tensor<3>,
        tokens: &KeyValueCache,
        transforms: Option<&TokenTransforms>,
    ) -> Tensor<3> {
        let block = &self.blocks[index];
        let key_value = match tokens {
            KeyValueCache::Tokens(tokens) => tokens.project(block),
            KeyValueCache::Projected { blocks, .. } => blocks[index].clone(),
        };
        block.forward(x, key_value, transforms)
    }

    fn to_image(&self, x: Tensor<3>, targets: &Cameras) -> Tensor<5> {
        decode_image(&self.output_norm, &self.to_pixels, x, targets, self.patches.size)
    }
}
