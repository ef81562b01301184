//! The encoder-decoder of LVSM (arXiv 2410.17242), a baseline: learned latents are encoded beside the patches of the context
//! views by self-attention, and decoded beside the patches of a target view by self-attention.
// B scenes, T target views, N patches of all context views, L latents, Q patches of a view, D width

use burn::module::{Module, Param};
use burn::nn::{LayerNorm, Linear};
use burn::tensor::Tensor;

use crate::error::ModelError;
use crate::network::architecture::{CameraEncoding, CliftVariant};
use crate::network::blocks::block::EncoderBlock;
use crate::network::blocks::pixels::{decode_image, embed_context, embed_rays};
use crate::network::camera_encoding::TokenTransforms;
use crate::network::config::{ModelConfig, SIZES, bad, check_absent, check_count};
use crate::network::design::{Design, EncoderBlocks, Patches, RendererBlocks};
use crate::network::init::{Init, LayerStyle};
use crate::network::layers::{
    CONTEXT, LATENTS, LATENTS_AND_CONTEXT, Layer, LayerKind, LayerList, Part, RENDER_TOKENS, TARGETS,
    TARGETS_AND_TOKENS,
};
use crate::network::render_tokens::KeyValueCache;
use crate::views::patch_grids::PatchGrids;
use crate::views::rays::RayFrame;
use crate::views::upload::{Cameras, Views};

/// LVSM's encoder-decoder, of its paper or of `CLiFT`'s release.
pub(crate) struct LvsmEd;

impl Design for LvsmEd {
    fn defaults(&self, variant: CliftVariant) -> ModelConfig {
        let (dim, num_heads, feed_forward_dim) = if variant.is_released() { (512, 8, 2048) } else { (768, 12, 3072) };
        ModelConfig { dim, num_heads, feed_forward_dim, num_latents: 3072, ..SIZES }
    }

    fn validate(&self, config: &ModelConfig) -> Result<(), ModelError> {
        check_count("model.num_encoder_blocks", config.num_encoder_blocks, 1 << 10)?;
        check_count("model.num_latents", config.num_latents, 1 << 16)?;
        check_absent("model.condenser.num_blocks", config.condenser.num_blocks, config)?;
        check_absent("model.group_size", config.group_size, config)?;
        if config.camera_encoding != CameraEncoding::Plucker {
            let fix = format!("model.architecture = \"{}\" has \"plucker\": leave the key out", config.architecture);
            return bad("model.camera_encoding", config.camera_encoding, fix);
        }
        if config.variant.has_norms() {
            let fix = "of LVSM, write \"paper\" or \"released-re10k\", its network in CLiFT's release".into();
            return bad("model.variant", config.variant, fix);
        }
        Ok(())
    }

    fn layers(&self, config: &ModelConfig) -> Vec<Layer> {
        let mut list = LayerList::new(config, self.layer_style(config));
        list.enter(Part::Encoder, None, "encoder");
        list.linear("patch_embed", [config.context_patch_len(), config.dim], CONTEXT, true);
        let latents = LayerKind::Table { rows: config.num_latents, width: config.dim };
        list.push("latents", latents, LATENTS_AND_CONTEXT, false);
        // The last block of either network computes the rows that are read after it.
        let num_blocks = config.num_encoder_blocks;
        for i in 0..num_blocks {
            list.enter(Part::Encoder, Some(i), &format!("encoder.blocks.{i}"));
            list.encoder_block(LATENTS_AND_CONTEXT, if i + 1 == num_blocks { LATENTS } else { LATENTS_AND_CONTEXT });
        }

        list.enter(Part::Renderer, None, "renderer");
        list.linear("ray_embed", [config.ray_patch_len(), config.dim], TARGETS, true);
        list.norm("joint.input_norm", if config.variant.is_released() { RENDER_TOKENS } else { TARGETS_AND_TOKENS });
        let num_blocks = config.num_renderer_blocks;
        for i in 0..num_blocks {
            list.enter(Part::Renderer, Some(i), &format!("renderer.joint.blocks.{i}"));
            list.encoder_block(TARGETS_AND_TOKENS, if i + 1 == num_blocks { TARGETS } else { TARGETS_AND_TOKENS });
        }
        list.output_head();
        list.layers
    }

    fn layer_style(&self, config: &ModelConfig) -> LayerStyle {
        if config.variant.is_released() {
            LayerStyle::PYTORCH
        } else {
            LayerStyle { has_biases: false, has_query_key_norms: true }
        }
    }

    fn num_learned_tokens(&self, config: &ModelConfig) -> Option<usize> {
        Some(config.num_latents)
    }

    fn supports_clusters(&self) -> bool {
        false
    }

    fn supports_export(&self) -> bool {
        false
    }
}

/// Self-attention over `[latents; patches]`, which returns the latents.
#[derive(Module, Debug)]
pub struct LatentEncoder {
    latents: Latents,
    patch_embed: Linear,
    blocks: Vec<EncoderBlock>,
    /// Whether colours are in `[-1, 1]`, as in LVSM's paper, instead of `[0, 1]`.
    #[module(skip)]
    has_signed_colors: bool,
    #[module(skip)]
    patch_size: usize,
}

/// Learned tokens.
#[derive(Module, Debug)]
struct Latents {
    /// `[1, L, D]`
    weight: Param<Tensor<3>>,
}

impl LatentEncoder {
    /// Makes an encoder of the sizes of `config`.
    pub fn new(config: &ModelConfig, init: &mut Init) -> Self {
        Self {
            latents: Latents { weight: init.latents(config.num_latents, config.dim) },
            patch_embed: init.block(None).linear(config.context_patch_len(), config.dim),
            blocks: (0..config.num_encoder_blocks).map(|i| EncoderBlock::new(config, init.block(Some(i)))).collect(),
            has_signed_colors: !config.variant.is_released(),
            patch_size: config.patch_size,
        }
    }
}

impl EncoderBlocks for LatentEncoder {
    fn embed(&self, context: &Views) -> Tensor<3> {
        let colors = context.images.clone();
        let colors = if self.has_signed_colors { colors * 2.0 - 1.0 } else { colors };
        let patches = embed_context(&self.patch_embed, colors, &context.cameras, self.patch_size, RayFrame::World);
        let ([batch, ..], [_, count, dim]) = (patches.dims(), self.latents.weight.dims());
        Tensor::cat(vec![self.latents.weight.val().expand([batch, count, dim]), patches], 1) // [B, L + N, D]
    }

    fn num_blocks(&self) -> usize {
        self.blocks.len()
    }

    /// The last block drops the patches.
    fn block(&self, index: usize, x: Tensor<3>, _transforms: Option<&TokenTransforms>) -> Tensor<3> {
        if index + 1 == self.blocks.len() {
            self.blocks[index].forward_first(x, self.latents.weight.dims()[1])
        } else {
            self.blocks[index].forward(x, None)
        }
    }
}

/// Self-attention over the patches of a target view and all latents.
#[derive(Module, Debug)]
pub struct JointRenderer {
    ray_embed: Linear,
    joint: JointDecoder,
    output_norm: LayerNorm,
    to_pixels: Linear,
    #[module(skip)]
    patches: Patches,
}

impl JointRenderer {
    /// Makes a renderer of the sizes of `config`.
    pub fn new(config: &ModelConfig, init: &mut Init) -> Self {
        Self {
            ray_embed: init.block(None).linear(config.ray_patch_len(), config.dim),
            joint: JointDecoder::new(config, init),
            output_norm: init.layer_norm(config.dim),
            to_pixels: init.block(None).linear(config.dim, config.rgb_patch_len()),
            patches: Patches::new(config),
        }
    }
}

impl RendererBlocks for JointRenderer {
    fn patches(&self) -> Patches {
        self.patches
    }

    fn set_patch_grids(&mut self, patch_grids: PatchGrids) {
        self.patches.grids = patch_grids;
    }

    fn embed(&self, tokens: &KeyValueCache, targets: &Cameras) -> Tensor<3> {
        self.joint.join(embed_rays(&self.ray_embed, targets, self.patches.size, RayFrame::World), tokens.sets())
    }

    fn num_blocks(&self) -> usize {
        self.joint.blocks.len()
    }

    fn block(
        &self,
        index: usize,
        x: Tensor<3>,
        tokens: &KeyValueCache,
        _transforms: Option<&TokenTransforms>,
    ) -> Tensor<3> {
        self.joint.block(index, x, tokens.num_tokens())
    }

    fn to_image(&self, x: Tensor<3>, targets: &Cameras) -> Tensor<5> {
        decode_image(&self.output_norm, &self.to_pixels, x, targets, self.patches.size)
    }
}

/// A norm and self-attention blocks over `[patches; latents]`.
#[derive(Module, Debug)]
struct JointDecoder {
    input_norm: LayerNorm,
    blocks: Vec<EncoderBlock>,
    /// Whether the norm covers the patches too, as in LVSM's paper; in `CLiFT`'s release it covers the latents alone.
    #[module(skip)]
    normalizes_patches: bool,
}

impl JointDecoder {
    fn new(config: &ModelConfig, init: &mut Init) -> Self {
        Self {
            input_norm: init.layer_norm(config.dim),
            blocks: (0..config.num_renderer_blocks).map(|i| EncoderBlock::new(config, init.block(Some(i)))).collect(),
            normalizes_patches: !config.variant.is_released(),
        }
    }

    /// Joins the patches of every view with the latents of its scene: the input of the first block.
    ///
    /// # Shapes
    /// - `patches`: `[batch * views, num_queries, dim]`
    /// - `latents`: `[batch, num_latents, dim]`, or one set per view
    /// - returns `[batch * views, num_queries + num_latents, dim]`
    fn join(&self, patches: Tensor<3>, latents: Tensor<3>) -> Tensor<3> {
        let norm = |x| self.input_norm.forward(x);
        let latents = if self.normalizes_patches { latents } else { norm(latents) };
        let ([views, ..], [groups, count, dim]) = (patches.dims(), latents.dims());
        let of_views = latents.unsqueeze_dim::<4>(1).expand([groups, views / groups, count, dim]);
        let joined = Tensor::cat(vec![patches, of_views.reshape([views, count, dim])], 1);
        if self.normalizes_patches { norm(joined) } else { joined }
    }

    /// Applies a block. The last one returns the patches alone.
    ///
    /// # Shapes
    /// - `x`: `[batch * views, num_queries + num_latents, dim]`
    /// - returns the same, or `[batch * views, num_queries, dim]` from the last block
    fn block(&self, block: usize, x: Tensor<3>, num_latents: usize) -> Tensor<3> {
        let [_, rows, _] = x.dims();
        if block + 1 == self.blocks.len() {
            self.blocks[block].forward_first(x, rows - num_latents)
        } else {
            self.blocks[block].forward(x, None)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{check_gradients, devices, random, small_lvsm, to_f64};

    #[test]
    fn gradients_equal_central_differences_in_f64() {
        for variant in [CliftVariant::Paper, CliftVariant::ReleasedRe10k] {
            for device in devices() {
                let config = ModelConfig { dim: 6, num_heads: 3, num_renderer_blocks: 2, ..small_lvsm(variant) };
                // PyTorch's distributions: LVSM's small matrices give near-uniform attention.
                let style = LayerStyle { has_query_key_norms: !variant.is_released(), ..LayerStyle::PYTORCH };
                let mut init = Init::with_style(style, 5, &device);
                let joint = to_f64(JointDecoder::new(&config, &mut init));
                let forward = |[patches, latents]: [Tensor<3>; 2]| {
                    let joint = if patches.is_autodiff() { joint.clone().train() } else { joint.clone() };
                    (0..2).fold(joint.join(patches, latents), |x, block| joint.block(block, x, 2))
                };
                // Two views of each of two scenes.
                let inputs = [random([4, 3, 6], 6, &device), random([2, 2, 6], 7, &device)];
                check_gradients(inputs, forward, 1e-6);
            }
        }
    }
}
