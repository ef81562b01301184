//! The neural renderer: tokens and a camera to an image (paper section 3.3).
// B scenes, T target views, G sets of tokens, Q patches of a view, R render tokens, D width

use burn::module::Module;
use burn::nn::{LayerNorm, Linear};
use burn::tensor::Tensor;
use burn::tensor::activation::sigmoid;

use crate::network::blocks::block::DecoderBlock;
use crate::network::camera_encoding::{TokenTransforms, TransformMaker};
use crate::network::config::ModelConfig;
use crate::network::init::Init;
use crate::network::joint_decoder::JointDecoder;
use crate::network::render_tokens::{KeyValueCache, RenderTokens};
use crate::ops::linear::{linear_in_f32, norm_linear};
use crate::views::patch::{patchify, unpatchify};
use crate::views::patch_grids::PatchGrids;
use crate::views::rays::plucker;
use crate::views::upload::Cameras;

/// A transformer decoder whose queries are the ray patches of a target view, or LVSM's joint decoder.
#[derive(Module, Debug)]
pub struct Renderer {
    ray_embed: Linear,
    /// Empty in LVSM.
    blocks: Vec<DecoderBlock>,
    /// The blocks of LVSM.
    joint: Option<JointDecoder>,
    output_norm: LayerNorm,
    to_pixels: Linear,
    #[module(skip)]
    patch_size: usize,
    #[module(skip)]
    patch_grids: PatchGrids,
    #[module(skip)]
    transforms: TransformMaker,
}

impl Renderer {
    /// Makes a renderer of the sizes of `config`.
    pub fn new(config: &ModelConfig, init: &mut Init) -> Self {
        let num_blocks = if config.has_latents() { 0 } else { config.num_renderer_blocks };
        Self {
            ray_embed: init.block(None).linear(config.ray_patch_len(), config.dim),
            blocks: (0..num_blocks).map(|_| DecoderBlock::new(config, init)).collect(),
            joint: JointDecoder::new(config, init),
            output_norm: init.layer_norm(config.dim),
            to_pixels: init.block(None).linear(config.dim, config.rgb_patch_len()),
            patch_size: config.patch_size,
            patch_grids: config.patch_grids,
            transforms: TransformMaker::new(config),
        }
    }

    /// Whether views are decoded together with all tokens, as in LVSM.
    pub(crate) fn is_joint(&self) -> bool {
        self.joint.is_some()
    }

    /// Returns the side of a patch in pixels.
    pub const fn patch_size(&self) -> usize {
        self.patch_size
    }

    /// Replaces the number of patch grids, that of the config at first.
    pub fn set_patch_grids(&mut self, patch_grids: PatchGrids) {
        self.patch_grids = patch_grids;
    }

    /// Renders target views from tokens, each the mean of its patch grids. Views are independent of each other.
    ///
    /// # Shapes
    /// - `tokens`: one set per scene, shared by its target views, or one set per target view
    /// - returns RGB in `(0, 1)`, `[batch, views, height, width, 3]`
    pub fn render(&self, tokens: impl Into<RenderTokens>, targets: &Cameras) -> Tensor<5> {
        // One grid needs no keys and values of all blocks at once.
        match self.patch_grids {
            PatchGrids::One => self.forward(tokens, targets),
            PatchGrids::Two | PatchGrids::Four => self.render_cached(&self.project_tokens(tokens), targets),
        }
    }

    /// Draws target views once, on one patch grid, as in training.
    ///
    /// # Shapes
    /// - as [`render`](Self::render)
    pub fn forward(&self, tokens: impl Into<RenderTokens>, targets: &Cameras) -> Tensor<5> {
        let tokens = tokens.into();
        let transforms = self.transforms(targets);
        let block = |x, block| self.block(block, x, &tokens, transforms.as_ref());
        self.to_image((0..self.num_blocks()).fold(self.embed(&tokens, targets), block), targets)
    }

    /// Makes the transforms of the patches of target views for camera-relative attention, one sequence per view; `None`
    /// without it.
    pub fn transforms(&self, targets: &Cameras) -> Option<TokenTransforms> {
        let [batch, views] = targets.dims();
        self.transforms.of_views(targets).map(|transforms| transforms.regroup(batch * views))
    }

    /// Projects tokens to keys and values in every block, for rendering many views.
    ///
    /// # Shapes
    /// - `tokens`: as [`render`](Self::render)
    pub fn project_tokens(&self, tokens: impl Into<RenderTokens>) -> KeyValueCache {
        let tokens = tokens.into();
        let blocks = self.blocks.iter().map(|block| tokens.project(block)).collect();
        let num_render_tokens = tokens.num_render_tokens();
        KeyValueCache { blocks, tokens: self.joint.is_some().then_some(tokens), num_render_tokens }
    }

    /// Renders target views as [`render`](Self::render) does, from the keys and values of
    /// [`project_tokens`](Self::project_tokens).
    ///
    /// # Shapes
    /// - returns RGB in `(0, 1)`, `[batch, views, height, width, 3]`
    pub fn render_cached(&self, cache: &KeyValueCache, targets: &Cameras) -> Tensor<5> {
        self.patch_grids.mean(self.patch_size, targets, |targets| self.forward_cached(cache, targets))
    }

    fn forward_cached(&self, cache: &KeyValueCache, targets: &Cameras) -> Tensor<5> {
        if let Some(tokens) = &cache.tokens {
            return self.forward(tokens.clone(), targets);
        }
        let x = self.embed_rays(targets);
        let transforms = self.transforms(targets);
        let blocks = self.blocks.iter().zip(&cache.blocks);
        let x = blocks.fold(x, |x, (block, key_value)| block.forward(x, key_value.clone(), transforms.as_ref()));
        self.to_image(x, targets)
    }

    /// Embeds the rays of every patch, before the tokens in LVSM: the input of the first block,
    /// `[batch * views, rows, dim]`.
    pub fn embed(&self, tokens: &RenderTokens, targets: &Cameras) -> Tensor<3> {
        let rays = self.embed_rays(targets);
        match &self.joint {
            Some(joint) => joint.join(rays, tokens.sets()),
            None => rays,
        }
    }

    /// `[batch * views, num_queries, dim]`
    fn embed_rays(&self, targets: &Cameras) -> Tensor<3> {
        let [batch, views] = targets.dims();
        let rays = linear_in_f32(&self.ray_embed, patchify(plucker(targets), self.patch_size)); // [B, TQ, D]
        let [_, queries, dim] = rays.dims();
        rays.reshape([batch * views, queries / views, dim])
    }

    /// Returns the number of blocks between [`embed`](Self::embed) and [`to_image`](Self::to_image).
    pub fn num_blocks(&self) -> usize {
        self.joint.as_ref().map_or(self.blocks.len(), JointDecoder::num_blocks)
    }

    /// Applies a block to the patches of target views.
    ///
    /// # Shapes
    /// - `x`: `[batch * views, rows, dim]`, as [`embed`](Self::embed) returns
    /// - returns the same, or `[batch * views, num_queries, dim]` from the last block
    pub fn block(
        &self,
        block: usize,
        x: Tensor<3>,
        tokens: &RenderTokens,
        transforms: Option<&TokenTransforms>,
    ) -> Tensor<3> {
        if let Some(joint) = &self.joint {
            return joint.block(block, x, tokens.num_render_tokens());
        }
        let block = &self.blocks[block];
        block.forward(x, tokens.project(block), transforms)
    }

    /// Decodes the output of the last block into images.
    ///
    /// # Shapes
    /// - `x`: `[batch * views, num_queries, dim]`
    /// - returns RGB in `(0, 1)`, `[batch, views, height, width, 3]`
    pub fn to_image(&self, x: Tensor<3>, targets: &Cameras) -> Tensor<5> {
        let [batch, views] = targets.dims();
        let num_queries = targets.height / self.patch_size * (targets.width / self.patch_size);
        let patches = sigmoid(norm_linear(&self.output_norm, &self.to_pixels, x));
        let [_, _, values] = patches.dims();
        let patches = patches.reshape([batch, views * num_queries, values]);
        unpatchify(patches, [views, targets.height, targets.width], self.patch_size)
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::{DType, Device};

    use super::*;
    use crate::testing::{assert_close, devices, random};

    fn inputs(device: &Device) -> (Renderer, Tensor<3>, Cameras) {
        let config = ModelConfig { dim: 16, num_heads: 4, feed_forward_dim: 24, ..ModelConfig::default() };
        let renderer = Renderer::new(&config, &mut Init::new(0, device));
        let tokens = random([2, 10, 16], 1, device).cast(DType::F32);
        let c2w = Tensor::<2>::eye(4, device).reshape([1, 1, 4, 4]).expand([2, 3, 4, 4]);
        let shift = random([2, 3, 4], 2, device).cast(DType::F32).reshape([2, 3, 4, 1]);
        let column = Tensor::<1>::from_floats([0.0, 0.0, 0.0, 0.3], device).reshape([1, 1, 1, 4]);
        let intrinsics = Tensor::<1>::from_floats([16.0, 16.0, 8.0, 8.0], device).reshape([1, 1, 4]).expand([2, 3, 4]);
        (renderer, tokens, Cameras { height: 16, width: 16, c2w: c2w + shift * column, intrinsics })
    }

    #[test]
    fn view_subsets_equal_their_tokens_alone_with_gradients() {
        // Few tokens per view are gathered before the projection, many after it.
        for count in [2, 7] {
            let subsets: Vec<Vec<Vec<u32>>> = (0..2)
                .map(|scene| (0..3).map(|view| (0..count).map(|i| (3 * i + view + scene) % 10).collect()).collect())
                .collect();
            let ids: Vec<i32> = subsets.iter().flatten().flatten().map(|&id| id as i32).collect();
            for device in devices() {
                let device = device.autodiff();
                let (renderer, tokens, cameras) = inputs(&device);
                let results = |alone: bool| {
                    let tokens = tokens.clone().detach().require_grad();
                    let images = if alone {
                        let each = |i: usize| {
                            let scene = tokens.clone().narrow(0, i / 3, 1);
                            let ids = &ids[i * count as usize..(i + 1) * count as usize];
                            scene.select(1, Tensor::from_ints(ids, &device))
                        };
                        renderer.forward(Tensor::cat((0..6).map(each).collect(), 0), &cameras)
                    } else {
                        renderer.forward(RenderTokens::subsets(tokens.clone(), &subsets), &cameras)
                    };
                    let grads = images.clone().square().mean().backward();
                    (images.inner(), tokens.grad(&grads).expect("tracked"))
                };
                let ((images, gradient), (expected_images, expected_gradient)) = (results(false), results(true));
                assert_close(&images, &expected_images, 1e-6);
                assert_close(&gradient, &expected_gradient, 1e-5);
            }
        }
    }
}
