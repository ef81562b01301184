//! The renderer: tokens and a camera to an image.

use burn::tensor::Tensor;

use crate::network::architecture::Architecture;
use crate::network::camera_encoding::TokenTransforms;
use crate::network::clift::renderer::CrossRenderer;
use crate::network::config::ModelConfig;
use crate::network::design::RendererBlocks;
use crate::network::init::Init;
use crate::network::lvsm_ed::JointRenderer;
use crate::network::parts::module_enum::module_enum;
use crate::network::render_tokens::{KeyValueCache, RenderTokens};
use crate::views::patch_grids::PatchGrids;
use crate::views::upload::Cameras;

module_enum! {
    /// A renderer. Target views are independent of each other.
    Renderer {
        /// Ray patches read the tokens by cross-attention.
        Clift(CrossRenderer),
        /// Ray patches and tokens are one sequence.
        LvsmEd(JointRenderer),
    }
}

impl Renderer {
    /// Makes a renderer of the sizes of `config`.
    pub fn new(config: &ModelConfig, init: &mut Init) -> Self {
        match config.architecture {
            Architecture::Clift => Self::Clift(CrossRenderer::new(config, init)),
            Architecture::LvsmEd => Self::LvsmEd(JointRenderer::new(config, init)),
        }
    }

    pub(crate) fn blocks(&self) -> &dyn RendererBlocks {
        match self {
            Self::Clift(renderer) => renderer,
            Self::LvsmEd(renderer) => renderer,
        }
    }

    /// Returns the side of a patch in pixels.
    pub fn patch_size(&self) -> usize {
        self.blocks().patches().size
    }

    /// Replaces the number of patch grids, which the config sets at first.
    pub fn set_patch_grids(&mut self, patch_grids: PatchGrids) {
        match self {
            Self::Clift(renderer) => renderer.set_patch_grids(patch_grids),
            Self::LvsmEd(renderer) => renderer.set_patch_grids(patch_grids),
        }
    }

    /// Renders target views from tokens, each the mean of its patch grids.
    ///
    /// # Shapes
    /// - `tokens`: one set per scene, shared by its target views, or one set per target view
    /// - returns RGB in `(0, 1)`, `[batch, views, height, width, 3]`
    ///
    /// # Panics
    /// As [`forward`](Self::forward).
    pub fn render(&self, tokens: impl Into<RenderTokens>, targets: &Cameras) -> Tensor<5> {
        // One grid needs no keys and values of all blocks at once.
        match self.blocks().patches().grids {
            PatchGrids::One => self.forward(tokens, targets),
            PatchGrids::Two | PatchGrids::Four => self.render_cached(&self.project_tokens(tokens), targets),
        }
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
    ///
    /// # Shapes
    /// - `tokens`: as [`render`](Self::render)
    ///
    /// # Panics
    /// As [`forward`](Self::forward).
    pub fn project_tokens(&self, tokens: impl Into<RenderTokens>) -> KeyValueCache {
        self.blocks().cache(self.accept(tokens.into()))
    }

    /// Renders target views as [`render`](Self::render) does, from the keys and values of
    /// [`project_tokens`](Self::project_tokens).
    ///
    /// # Shapes
    /// - returns RGB in `(0, 1)`, `[batch, views, height, width, 3]`
    pub fn render_cached(&self, cache: &KeyValueCache, targets: &Cameras) -> Tensor<5> {
        self.blocks().patches().grids.mean(self.patch_size(), targets, |targets| self.forward_cached(cache, targets))
    }

    fn forward_cached(&self, cache: &KeyValueCache, targets: &Cameras) -> Tensor<5> {
        let blocks = self.blocks();
        let transforms: Option<TokenTransforms> = blocks.transforms(targets);
        let forward = |x, index| blocks.block(index, x, cache, transforms.as_ref());
        blocks.to_image((0..blocks.num_blocks()).fold(blocks.embed(cache, targets), forward), targets)
    }

    /// Checks that tokens and target patches both have transforms, or neither: queries alone in the frame of their camera
    /// would give a wrong image.
    pub(crate) fn accept(&self, tokens: RenderTokens) -> RenderTokens {
        let is_camera_relative = self.blocks().is_camera_relative();
        assert!(
            tokens.has_transforms() || !is_camera_relative,
            "tokens without cameras for a network with camera-relative attention: take those that the network encoded, \
             or render a scene with `SceneRenderer`"
        );
        assert!(
            !tokens.has_transforms() || is_camera_relative,
            "tokens with the transforms of camera-relative attention for a network without it: take those that the \
             network encoded"
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
        inputs_of(CameraEncoding::Plucker, device)
    }

    fn inputs_of(camera_encoding: CameraEncoding, device: &Device) -> (Renderer, Tensor<3>, Cameras) {
        let sizes = ModelConfig { dim: 16, num_heads: 2, feed_forward_dim: 24, ..ModelConfig::default() };
        let config = ModelConfig { camera_encoding, ..sizes };
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
    #[should_panic(expected = "tokens without cameras for a network with camera-relative attention")]
    fn tokens_without_cameras_are_refused_by_camera_relative_attention() {
        let (renderer, tokens, cameras) = inputs_of(CameraEncoding::Gta, &Device::flex());
        renderer.render(Tokens::without_cameras(tokens), &cameras);
    }

    #[test]
    #[should_panic(expected = "for a network without it")]
    fn tokens_with_transforms_are_refused_by_plain_attention() {
        let device = Device::flex();
        let (relative, values, cameras) = inputs_of(CameraEncoding::Prope, &device);
        let transforms = relative.blocks().transforms(&cameras);
        let (renderer, ..) = inputs(&device);
        renderer.project_tokens(Tokens { values, transforms });
    }
}
