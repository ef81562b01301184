//! The renderer: ray patches of a target view read the tokens (paper section 3.3).
// B scenes, T target views, Q patches of a view, D width

use burn::module::Module;
use burn::nn::{LayerNorm, Linear};
use burn::tensor::Tensor;
use burn::tensor::activation::sigmoid;

use crate::network::architecture::Architecture;
use crate::network::blocks::block::DecoderBlock;
use crate::network::camera_encoding::transforms;
use crate::network::config::ModelConfig;
use crate::network::init::Init;
use crate::network::lvsm_ed::JointDecoder;
use crate::network::render_tokens::{KeyValueCache, RenderTokens};
use crate::ops::linear::{linear_in_f32, norm_linear};
use crate::views::patch::{patchify, unpatchify};
use crate::views::patch_grids::PatchGrids;
use crate::views::rays::rays;
use crate::views::upload::Cameras;

/// A transformer decoder whose queries are the ray patches of a target view, as a list of blocks on the residual stream of
/// target patches, `[batch * views, rows, dim]`. Target views are independent of each other.
#[derive(Module, Debug)]
pub struct Renderer {
    ray_embed: Linear,
    /// Of LVSM, in place of `blocks`.
    joint: Option<JointDecoder>,
    blocks: Vec<DecoderBlock>,
    output_norm: LayerNorm,
    to_pixels: Linear,
    #[module(skip)]
    config: ModelConfig,
}

impl Renderer {
    /// Makes a renderer of the sizes of `config`.
    pub fn new(config: &ModelConfig, init: &mut Init) -> Self {
        let is_joint = config.architecture == Architecture::LvsmEd;
        let num_decoder_blocks = if is_joint { 0 } else { config.num_renderer_blocks };
        Self {
            ray_embed: init.block(None).linear(config.ray_patch_len(), config.dim),
            joint: is_joint.then(|| JointDecoder::new(config, init)),
            blocks: (0..num_decoder_blocks).map(|_| DecoderBlock::new(config, init)).collect(),
            output_norm: init.layer_norm(config.dim),
            to_pixels: init.block(None).linear(config.dim, config.rgb_patch_len()),
            config: config.clone(),
        }
    }

    /// Returns the side of a patch in pixels.
    pub fn patch_size(&self) -> usize {
        self.config.patch_size
    }

    /// Replaces the number of patch grids, which the config sets at first.
    pub fn set_patch_grids(&mut self, patch_grids: PatchGrids) {
        self.config.patch_grids = patch_grids;
    }

    /// Renders target views from tokens, each the mean of its patch grids.
    ///
    /// # Shapes
    /// - `tokens`: one set per scene, shared by its target views, or one set per target view
    /// - returns RGB in `(0, 1)`, `[batch, views, height, width, 3]`
    pub fn render(&self, tokens: impl Into<RenderTokens>, targets: &Cameras) -> Tensor<5> {
        let ModelConfig { patch_grids, patch_size, .. } = self.config;
        // One grid needs no keys and values of all blocks at once.
        if patch_grids == PatchGrids::One {
            return self.forward(tokens, targets);
        }
        let cache = self.project_tokens(tokens);
        patch_grids.mean(patch_size, targets, |targets| self.forward_cached(&cache, targets))
    }

    /// Renders target views once, on one patch grid, as in training.
    ///
    /// # Shapes
    /// - as [`render`](Self::render)
    ///
    /// # Panics
    /// If the tokens have transforms and the network's attention is not camera-relative, or the other way round.
    pub fn forward(&self, tokens: impl Into<RenderTokens>, targets: &Cameras) -> Tensor<5> {
        self.forward_cached(&KeyValueCache::Tokens(self.accept(tokens.into())), targets)
    }

    /// Projects tokens to keys and values in every block, for rendering many views.
    pub fn project_tokens(&self, tokens: impl Into<RenderTokens>) -> KeyValueCache {
        let tokens = self.accept(tokens.into());
        if self.joint.is_some() {
            return KeyValueCache::Tokens(tokens);
        }
        KeyValueCache::Projected(self.blocks.iter().map(|block| tokens.project(block)).collect())
    }

    /// Returns the number of patch grids that an image is the mean of.
    pub fn num_patch_grids(&self) -> usize {
        self.config.patch_grids.patches(self.config.patch_size, [0; 2]).count()
    }

    /// Renders target views on one of the patch grids, from the keys and values of [`project_tokens`](Self::project_tokens).
    ///
    /// # Shapes
    /// - as [`render`](Self::render)
    pub fn render_on_grid(&self, cache: &KeyValueCache, targets: &Cameras, grid: usize) -> Tensor<5> {
        let ModelConfig { patch_grids, patch_size, .. } = self.config;
        patch_grids.draw(patch_size, targets, grid, |targets| self.forward_cached(cache, targets))
    }

    fn forward_cached(&self, cache: &KeyValueCache, targets: &Cameras) -> Tensor<5> {
        let ModelConfig { patch_size, rays: frame, .. } = self.config;
        let [batch, views] = targets.dims();
        // Views are sequences of their own: [B, TQ, D] -> [BT, Q, D]
        let of_views = |x: Tensor<3>| {
            let [_, count, width] = x.dims();
            x.reshape([batch * views, count / views, width])
        };
        let x = of_views(linear_in_f32(&self.ray_embed, patchify(rays(targets, frame), patch_size)));
        let x = if let Some(joint) = &self.joint {
            joint.forward(x, cache.sets())
        } else {
            let transforms = transforms(&self.config, targets).map(of_views);
            self.blocks.iter().enumerate().fold(x, |x, (index, block)| {
                let key_value = match cache {
                    KeyValueCache::Tokens(tokens) => tokens.project(block),
                    KeyValueCache::Projected(blocks) => blocks[index].clone(),
                };
                block.forward(x, key_value, transforms.as_ref())
            })
        };
        let patches = sigmoid(norm_linear(&self.output_norm, &self.to_pixels, x)); // [BT, Q, values of a patch]
        let [_, num_queries, values] = patches.dims();
        let patches = patches.reshape([batch, views * num_queries, values]);
        unpatchify(patches, [views, targets.height, targets.width], patch_size)
    }

    /// Checks that tokens and target patches both have transforms, or neither: queries alone in the frame of their camera
    /// would give a wrong image.
    fn accept(&self, tokens: RenderTokens) -> RenderTokens {
        assert_eq!(
            tokens.has_transforms(),
            self.config.is_camera_relative(),
            "camera-relative attention needs tokens with cameras, and plain attention tokens without: take those that the \
             network encoded, or render a scene with `SceneRenderer`"
        );
        tokens
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::{DType, Device};

    use super::*;
    use crate::network::architecture::CameraEncoding;
    use crate::network::tokens::Tokens;
    use crate::testing::{assert_close, devices, random};

    fn inputs(device: &Device) -> (Renderer, Tensor<3>, Cameras) {
        let config = ModelConfig { dim: 16, num_heads: 2, feed_forward_dim: 24, ..ModelConfig::default() };
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
                        let alone = Tensor::cat((0..6).map(each).collect(), 0);
                        renderer.forward(Tokens::without_cameras(alone), &cameras)
                    } else {
                        let tokens = Tokens::without_cameras(tokens.clone());
                        renderer.forward(RenderTokens::subsets(tokens, &subsets), &cameras)
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

    #[test]
    #[should_panic(expected = "camera-relative attention needs tokens with cameras")]
    fn tokens_without_cameras_are_refused_by_camera_relative_attention() {
        let (mut renderer, tokens, cameras) = inputs(&Device::flex());
        renderer.config.camera_encoding = CameraEncoding::Gta;
        renderer.render(Tokens::without_cameras(tokens), &cameras);
    }
}
