//! The neural renderer: tokens and a camera to a picture (paper section 3.3).
// B scenes, T target views, G sets of tokens, Q patches of a view, R render tokens, D width

use burn::module::Module;
use burn::nn::{LayerNorm, Linear};
use burn::tensor::{Int, Tensor, TensorData, activation::sigmoid};

use crate::block::DecoderBlock;
use crate::linear::{linear_in_f32, linear_of_norm};
use crate::patch::{patchify, unpatchify};
use crate::rays::plucker;
use crate::{Cameras, Init, ModelConfig};

/// A transformer decoder whose queries are the target's ray patches.
#[derive(Module, Debug)]
pub struct Renderer {
    ray_embed: Linear,
    blocks: Vec<DecoderBlock>,
    output_norm: LayerNorm,
    to_pixels: Linear,
    #[module(skip)]
    patch_size: usize,
}

impl Renderer {
    /// Side of a patch in pixels.
    pub const fn patch_size(&self) -> usize {
        self.patch_size
    }

    /// Makes a renderer of the sizes of `config`.
    pub fn new(config: &ModelConfig, init: &mut Init) -> Self {
        Self {
            ray_embed: init.linear(config.ray_patch_len(), config.dim),
            blocks: (0..config.num_renderer_blocks).map(|_| DecoderBlock::new(config, init)).collect(),
            output_norm: init.layer_norm(config.dim),
            to_pixels: init.linear(config.dim, config.rgb_patch_len()),
            patch_size: config.patch_size,
        }
    }

    /// Draws target views from tokens. Views are independent of each other.
    ///
    /// # Shapes
    /// - `tokens`: one set per scene, shared by all its target views, or one set per target view
    /// - returns RGB in `(0, 1)`, `[batch, views, height, width, 3]`
    pub fn forward(&self, tokens: impl Into<RenderTokens>, targets: &Cameras) -> Tensor<5> {
        let tokens = tokens.into();
        let x = self.embed(targets);
        let x = self.blocks.iter().fold(x, |x, block| block.forward(x, tokens.memory(block)));
        self.picture(x, targets)
    }

    /// Keys and values of a scene's tokens in every block, for drawing it many times.
    ///
    /// # Shapes
    /// - `tokens`: `[batch, num_render_tokens, dim]`
    pub fn memory(&self, tokens: &Tensor<3>) -> SceneMemory {
        let blocks = self.blocks.iter().map(|block| block.memory(tokens.clone())).collect();
        SceneMemory { blocks, num_render_tokens: tokens.dims()[1] }
    }

    /// Draws target views as [`forward`](Self::forward) does, from what [`memory`](Self::memory) prepared.
    ///
    /// # Shapes
    /// - returns RGB in `(0, 1)`, `[batch, views, height, width, 3]`
    pub fn draw(&self, memory: &SceneMemory, targets: &Cameras) -> Tensor<5> {
        let x = self.embed(targets);
        let x = self.blocks.iter().zip(&memory.blocks).fold(x, |x, (block, memory)| block.forward(x, memory.clone()));
        self.picture(x, targets)
    }

    /// What the first block starts from: the embedded rays of every patch, `[batch * views, num_queries, dim]`.
    pub fn embed(&self, targets: &Cameras) -> Tensor<3> {
        let [batch, views] = targets.dims();
        let rays = linear_in_f32(&self.ray_embed, patchify(plucker(targets), self.patch_size)); // [B, TQ, D]
        let [_, queries, dim] = rays.dims();
        rays.reshape([batch * views, queries / views, dim])
    }

    /// The blocks between [`embed`](Self::embed) and [`picture`](Self::picture).
    pub fn blocks(&self) -> &[DecoderBlock] {
        &self.blocks
    }

    /// The picture in what the last block gives.
    ///
    /// # Shapes
    /// - `x`: `[batch * views, num_queries, dim]`
    /// - returns RGB in `(0, 1)`, `[batch, views, height, width, 3]`
    pub fn picture(&self, x: Tensor<3>, targets: &Cameras) -> Tensor<5> {
        let [batch, views] = targets.dims();
        let patches = sigmoid(linear_of_norm(&self.output_norm, &self.to_pixels, x));
        let [_, num_queries, values] = patches.dims();
        let patches = patches.reshape([batch, views * num_queries, values]);
        unpatchify(patches, [views, targets.height, targets.width], self.patch_size)
    }
}

/// Keys and values of a scene's tokens in every block of a renderer.
#[derive(Clone, Debug)]
pub struct SceneMemory {
    /// Each `[batch, num_render_tokens, 2 dim]`.
    blocks: Vec<Tensor<3>>,
    num_render_tokens: usize,
}

impl SceneMemory {
    /// How many tokens it is of.
    pub fn num_render_tokens(&self) -> usize {
        self.num_render_tokens
    }

    /// The memory of some of the tokens, by their places.
    #[must_use]
    pub fn select(&self, tokens: &[u32]) -> Self {
        let Some(first) = self.blocks.first() else {
            return self.clone();
        };
        let places: Vec<i64> = tokens.iter().map(|&token| i64::from(token)).collect();
        let places = Tensor::<1, Int>::from_data(TensorData::new(places, [tokens.len()]), &first.device());
        let blocks = self.blocks.iter().map(|memory| memory.clone().select(1, places.clone())).collect();
        Self { blocks, num_render_tokens: tokens.len() }
    }
}

/// The tokens that target views are drawn from.
#[derive(Clone, Debug)]
pub struct RenderTokens {
    /// `[batch, num_tokens, dim]`
    tokens: Tensor<3>,
    /// Where every target view has a set of its own: its rows among the tokens of all scenes, `[groups, R]`.
    rows: Option<Tensor<2, Int>>,
}

impl From<Tensor<3>> for RenderTokens {
    /// One set per scene, `[batch, num_render_tokens, dim]`, or per target view, `[batch * views, ..]`.
    fn from(tokens: Tensor<3>) -> Self {
        Self { tokens, rows: None }
    }
}

impl RenderTokens {
    /// For every target view of every scene its own equally large subset of the scene's tokens:
    /// `subsets[scene][view]` are token ids.
    ///
    /// # Shapes
    /// - `tokens`: `[batch, num_tokens, dim]`
    pub fn subsets(tokens: Tensor<3>, subsets: &[Vec<Vec<u32>>]) -> Self {
        let [batch, num_tokens, _dim] = tokens.dims();
        let groups: usize = subsets.iter().map(Vec::len).sum();
        let rows: Vec<i64> = subsets
            .iter()
            .enumerate()
            .flat_map(|(scene, views)| views.iter().flatten().map(move |&token| (scene, token)))
            .map(|(scene, token)| (scene * num_tokens) as i64 + i64::from(token))
            .collect();
        let count = rows.len();
        let rows = Tensor::<1, Int>::from_data(TensorData::new(rows, [count]), &tokens.device());
        let rows = rows.reshape([groups, count / groups]);
        // Keys and values are projected for what there is less of: the tokens, or the subsets together.
        if count < batch * num_tokens { gather(tokens, rows).into() } else { Self { tokens, rows: Some(rows) } }
    }

    /// The same sets of other tokens in the same places, on the tape where those are.
    #[must_use]
    pub fn with_tokens(&self, tokens: Tensor<3>) -> Self {
        let rows = self.rows.clone().map(|rows| if tokens.is_autodiff() { rows.autodiff() } else { rows });
        Self { tokens, rows }
    }

    /// The tokens that keys and values are projected from.
    pub fn tokens(&self) -> &Tensor<3> {
        &self.tokens
    }

    /// Keys and values of every set, `[groups, num_render_tokens, 2 dim]`.
    pub fn memory(&self, block: &DecoderBlock) -> Tensor<3> {
        let memory = block.memory(self.tokens.clone());
        match &self.rows {
            Some(rows) => gather(memory, rows.clone()),
            None => memory,
        }
    }
}

/// `[B, N, D]`, rows `[G, R]` of `[BN, D] -> [G, R, D]`
fn gather(x: Tensor<3>, rows: Tensor<2, Int>) -> Tensor<3> {
    let ([batch, count, dim], [groups, kept]) = (x.dims(), rows.dims());
    x.reshape([batch * count, dim]).select(0, rows.reshape([groups * kept])).reshape([groups, kept, dim])
}

#[cfg(test)]
mod tests {
    use burn::tensor::{DType, Device};

    use super::*;
    use crate::testing::{assert_close, devices, random};

    fn setting(device: &Device) -> (Renderer, Tensor<3>, Cameras) {
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
    fn a_prepared_scene_is_drawn_as_an_unprepared_one() {
        for device in devices() {
            let (renderer, tokens, cameras) = setting(&device);
            let drawn = renderer.draw(&renderer.memory(&tokens), &cameras);
            assert_close(&drawn, &renderer.forward(tokens, &cameras), 0.0);
        }
    }

    #[test]
    fn subsets_per_view_are_drawn_as_their_tokens_alone_with_the_same_gradients() {
        // Few tokens of each view: gathered before the projection. Many: after it.
        for count in [2, 7] {
            let subsets: Vec<Vec<Vec<u32>>> = (0..2)
                .map(|scene| (0..3).map(|view| (0..count).map(|i| (3 * i + view + scene) % 10).collect()).collect())
                .collect();
            let ids: Vec<i32> = subsets.iter().flatten().flatten().map(|&id| id as i32).collect();
            for device in devices() {
                let device = device.autodiff();
                let (renderer, tokens, cameras) = setting(&device);
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
