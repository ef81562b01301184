//! The interface of an architecture: what it defines about its configs, its layers and its modules.

use burn::tensor::Tensor;

use crate::error::ModelError;
use crate::network::architecture::CliftVariant;
use crate::network::camera_encoding::TokenTransforms;
use crate::network::config::ModelConfig;
use crate::network::init::LayerStyle;
use crate::network::layers::Layer;
use crate::network::render_tokens::{KeyValueCache, RenderTokens};
use crate::views::patch_grids::PatchGrids;
use crate::views::upload::{Cameras, Views};

/// An architecture. Its modules implement [`EncoderBlocks`] and [`RendererBlocks`].
pub(crate) trait Design {
    /// Returns the config of a variant whose keys are left out. Architecture and variant are set by the caller.
    fn defaults(&self, variant: CliftVariant) -> ModelConfig;

    /// Checks the values that other architectures lack or limit in another way.
    fn validate(&self, config: &ModelConfig) -> Result<(), ModelError>;

    /// Lists every layer in the order of published checkpoints: encoder, token norm, renderer, condenser; within a block
    /// attention, feed-forward network, norms.
    fn layers(&self, config: &ModelConfig) -> Vec<Layer>;

    /// Returns the parameters that the layers have.
    fn layer_style(&self, config: &ModelConfig) -> LayerStyle;

    /// Returns the number of tokens of a scene that are learned and belong to no view; `None` for a token per patch.
    fn num_learned_tokens(&self, _config: &ModelConfig) -> Option<usize> {
        None
    }

    /// Whether tokens can be clustered and condensed; other networks are trained in stage 1 alone and store all tokens.
    fn supports_clusters(&self) -> bool {
        true
    }

    /// Whether published checkpoints have names for the parameters.
    fn supports_export(&self) -> bool {
        true
    }
}

/// An encoder as a list of blocks on the residual stream.
pub(crate) trait EncoderBlocks {
    /// Makes the transforms of the tokens for camera-relative attention, one sequence per group of views; `None` without it.
    fn transforms(&self, _context: &Cameras) -> Option<TokenTransforms> {
        None
    }

    /// Makes the input of the first block, `[batch * groups, rows, dim]`: one sequence per group of views that the encoder
    /// reads together.
    fn embed(&self, context: &Views) -> Tensor<3>;

    /// Returns the number of blocks.
    fn num_blocks(&self) -> usize;

    /// Applies a block; the last one returns the tokens, `[batch * groups, num_tokens / groups, dim]`.
    fn block(&self, index: usize, x: Tensor<3>, transforms: Option<&TokenTransforms>) -> Tensor<3>;
}

/// A renderer as a list of blocks on the residual stream of target patches, `[batch * views, rows, dim]`.
pub(crate) trait RendererBlocks {
    /// Returns the side of a patch in pixels, and the patch grids of an image.
    fn patches(&self) -> Patches;

    /// Replaces the patch grids.
    fn set_patch_grids(&mut self, patch_grids: PatchGrids);

    /// Whether attention is camera-relative: tokens and target patches then have transforms.
    fn is_camera_relative(&self) -> bool {
        false
    }

    /// Makes the transforms of target patches, one sequence per view; `None` without camera-relative attention.
    fn transforms(&self, _targets: &Cameras) -> Option<TokenTransforms> {
        None
    }

    /// Computes what is the same for all views of the tokens.
    fn cache(&self, tokens: RenderTokens) -> KeyValueCache {
        KeyValueCache::Tokens(tokens)
    }

    /// Makes the input of the first block.
    fn embed(&self, tokens: &KeyValueCache, targets: &Cameras) -> Tensor<3>;

    /// Returns the number of blocks.
    fn num_blocks(&self) -> usize;

    /// Applies a block; the last one returns `[batch * views, num_queries, dim]`.
    fn block(
        &self,
        index: usize,
        x: Tensor<3>,
        tokens: &KeyValueCache,
        transforms: Option<&TokenTransforms>,
    ) -> Tensor<3>;

    /// Decodes the output of the last block into RGB in `(0, 1)`, `[batch, views, height, width, 3]`.
    fn to_image(&self, x: Tensor<3>, targets: &Cameras) -> Tensor<5>;
}

/// Side of a patch in pixels, and the patch grids of an image.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Patches {
    pub size: usize,
    pub grids: PatchGrids,
}

impl Patches {
    pub fn new(config: &ModelConfig) -> Self {
        Self { size: config.patch_size, grids: config.patch_grids }
    }
}
