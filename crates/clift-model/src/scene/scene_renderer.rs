//! A scene on a device, ready to be drawn from anywhere: its renderer, its tokens and what the last frame was drawn
//! from.
// S stored tokens, R rendered tokens, D width

use std::path::Path;
use std::time::Instant;

use burn::tensor::{Device, Tensor, TensorData};

use crate::error::ModelError;
use crate::network::render_tokens::KeyValueCache;
use crate::network::renderer::Renderer;
use crate::scene::scene::Scene;
use crate::tokens::selection::rules::SelectionRules;
use crate::tokens::selection::selector::Selector;
use crate::views::camera::ViewCamera;
use crate::views::upload::Cameras;
use crate::weights::hash::renderer_hash;
use crate::weights::trained_model::open_renderer;

/// Most frames that are drawn by one call where all tokens are used: they share keys and values.
const FRAMES_PER_CALL: usize = 8;

/// Most patches that one call draws of several frames: eight of 512 x 512 pixels.
const PATCHES_PER_CALL: usize = 1 << 15;

/// How many frames of so many patches one call draws at best.
pub fn frames_per_call(num_patches: usize) -> usize {
    (PATCHES_PER_CALL / num_patches.max(1)).clamp(1, FRAMES_PER_CALL)
}

/// Reads the renderer that a scene was made for out of a weight file.
///
/// # Errors
/// [`ModelError::Weights`] for a file that cannot be read or holds no such renderer, [`ModelError::OtherRenderer`] for
/// other weights.
pub fn load_renderer(scene: &Scene, weights: &Path, device: &Device) -> Result<Renderer, ModelError> {
    let renderer = open_renderer(&scene.model, weights, device)?;
    let got = renderer_hash(&renderer, &scene.model);
    if got != scene.renderer_hash {
        return Err(ModelError::OtherRenderer { expected: scene.renderer_hash.clone(), got, path: weights.into() });
    }
    Ok(renderer)
}

/// One drawn frame.
#[derive(Clone, Debug, PartialEq)]
pub struct RenderedViews {
    /// RGB in `(0, 1)`, `[height, width, 3]`.
    pub pixels: Vec<f32>,
    /// The tokens it was drawn from, ascending; `None` for all.
    pub tokens: Option<Vec<u32>>,
    /// Seconds token selection took.
    pub select_s: f64,
    /// Seconds from the tokens to the pixels on the host; the mean of those drawn by one call.
    pub render_s: f64,
}

/// Draws frames of a scene one after the other.
#[derive(Debug)]
pub struct SceneRenderer {
    renderer: Renderer,
    /// Of all stored tokens: what every frame draws from, or from a part of.
    memory: KeyValueCache,
    selector: Selector,
    device: Device,
}

impl SceneRenderer {
    /// Copies a scene's tokens to a device. `renderer` is that of [`load_renderer`], on the same device.
    ///
    /// # Errors
    /// [`ModelError::BadRay`] for a scene that was not read from a file and has rays that are not finite.
    pub fn new(scene: &Scene, renderer: Renderer, rules: SelectionRules, device: &Device) -> Result<Self, ModelError> {
        let shape = [1, scene.num_tokens(), scene.model.dim];
        let tokens = Tensor::from_data(TensorData::new(scene.tokens.clone(), shape), device);
        let selector = Selector::new(rules, &scene.token_rays())?;
        Ok(Self { memory: renderer.memory(&tokens), renderer, selector, device: device.clone() })
    }

    /// How many tokens the scene has.
    pub fn num_storage_tokens(&self) -> usize {
        self.memory.num_render_tokens()
    }

    /// How many frames one call draws at best: fewer of large pictures.
    pub fn frames_per_call(&self, height: usize, width: usize) -> usize {
        let patch_size = self.renderer.patch_size();
        frames_per_call(height / patch_size * (width / patch_size))
    }

    /// Forgets the previous frame.
    pub fn reset(&mut self) {
        self.selector.reset();
    }

    /// Draws the next frames of a path, each from `num_render_tokens` tokens of its own, or all of them from all tokens.
    ///
    /// Frames of all tokens are drawn [`Self::frames_per_call`] at a time.
    ///
    /// # Errors
    /// [`ModelError::NotFinite`] for a camera or a picture that is not finite, [`ModelError::BadConfig`] for no tokens,
    /// [`ModelError::Device`] when a picture cannot be read back.
    ///
    /// # Panics
    /// For a size that is no multiple of the patch.
    pub fn draw(
        &mut self,
        views: &[ViewCamera],
        height: usize,
        width: usize,
        num_render_tokens: usize,
    ) -> Result<Vec<RenderedViews>, ModelError> {
        if num_render_tokens >= self.num_storage_tokens() {
            let mut drawn = Vec::with_capacity(views.len());
            for views in views.chunks(self.frames_per_call(height, width)) {
                drawn.extend(self.render(views, height, width, None, 0.0)?);
            }
            return Ok(drawn);
        }
        let mut drawn = Vec::with_capacity(views.len());
        for view in views {
            let started = Instant::now();
            let chosen = self.selector.select(view, height, width, num_render_tokens)?;
            let select_s = started.elapsed().as_secs_f64();
            drawn.extend(self.render(&[*view], height, width, Some(chosen), select_s)?);
        }
        Ok(drawn)
    }

    fn render(
        &self,
        views: &[ViewCamera],
        height: usize,
        width: usize,
        chosen: Option<Vec<u32>>,
        select_s: f64,
    ) -> Result<Vec<RenderedViews>, ModelError> {
        let started = Instant::now();
        let cameras = Cameras::of_views(views, height, width, &self.device)?;
        let pictures = match &chosen {
            None => self.renderer.draw(&self.memory, &cameras),
            Some(chosen) => self.renderer.draw(&self.memory.select(chosen), &cameras),
        };
        let pictures = pictures.into_data().convert::<f32>();
        let pixels =
            pictures.try_to_vec::<f32>().map_err(|error| ModelError::Device { reason: format!("{error:?}") })?;
        let render_s = started.elapsed().as_secs_f64() / views.len() as f64;
        if let Some(position) = pixels.iter().position(|value| !value.is_finite()) {
            return Err(ModelError::NotFinite { name: "a rendering", value: pixels[position], position });
        }
        let frames = pixels.chunks_exact(height * width * 3);
        Ok(frames
            .map(|pixels| RenderedViews { pixels: pixels.to_vec(), tokens: chosen.clone(), select_s, render_s })
            .collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::network::clift::Clift;
    use crate::network::config::ModelConfig;
    use crate::scene::scene::SceneNormalization;
    use crate::testing::devices;
    use crate::tokens::kind::TokenKind;
    use crate::tokens::selection::rules::SelectionPreset;
    use crate::weights::file;
    use crate::weights::hash;

    const MODEL: ModelConfig = ModelConfig {
        variant: crate::network::architecture::CliftVariant::Paper,
        dim: 16,
        num_heads: 2,
        feed_forward_dim: 24,
        num_encoder_blocks: 1,
        num_renderer_blocks: 2,
        patch_size: 8,
        condenser: crate::network::config::CondenserConfig { num_blocks: 1, residual: true },
    };

    fn camera(x: f64, angle: f64) -> ViewCamera {
        let (sin, cos) = angle.sin_cos();
        ViewCamera {
            c2w: [cos, 0.0, sin, x, 0.0, 1.0, 0.0, 0.0, -sin, 0.0, cos, 0.0, 0.0, 0.0, 0.0, 1.0],
            intrinsics: [20.0, 20.0, 12.0, 8.0],
        }
    }

    fn scene(renderer: &Renderer) -> Scene {
        let token_ids: Vec<u32> = (0..12).collect();
        Scene {
            key: "room".into(),
            kind: TokenKind::Clift,
            model: MODEL,
            renderer_hash: hash::renderer_hash(renderer, &MODEL),
            model_path: String::new(),
            height: 16,
            width: 24,
            context: vec![camera(-1.0, 0.3), camera(1.0, -0.3)],
            context_frames: vec![0, 1],
            world: SceneNormalization { mean_c2w: camera(0.0, 0.0).c2w, scale: 1.0 },
            tokens: (0..token_ids.len() * 16).map(|i| ((i * 37 % 101) as f32 - 50.0) * 0.02).collect(),
            token_ids,
        }
    }

    fn viewer(device: &Device, preset: SelectionPreset) -> (SceneRenderer, Scene, Renderer) {
        let renderer = Clift::new(&MODEL, 3, device).renderer;
        let scene = scene(&renderer);
        (SceneRenderer::new(&scene, renderer.clone(), preset.rules(), device).unwrap(), scene, renderer)
    }

    fn path(num_frames: usize) -> Vec<ViewCamera> {
        (0..num_frames).map(|i| camera(-0.5 + 0.1 * i as f64, 0.1 - 0.02 * i as f64)).collect()
    }

    fn largest_difference(a: &[f32], b: &[f32]) -> f32 {
        assert_eq!(a.len(), b.len());
        a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
    }

    #[test]
    fn frames_of_all_tokens_are_those_the_renderer_draws_alone() {
        for device in devices() {
            let (mut viewer, scene, renderer) = viewer(&device, SelectionPreset::Paper);
            let drawn = viewer.draw(&path(11), 16, 24, 12).unwrap();
            assert_eq!(drawn.len(), 11);
            let tokens: Tensor<3> = Tensor::from_data(TensorData::new(scene.tokens.clone(), [1, 12, 16]), &device);
            for (view, drawn) in path(11).iter().zip(&drawn) {
                let cameras = Cameras::of_views(&[*view], 16, 24, &device).unwrap();
                let alone = renderer.forward(tokens.clone(), &cameras).into_data().convert::<f32>();
                // Eight views are multiplied in blocks of other sizes than one.
                assert!(largest_difference(&drawn.pixels, alone.as_slice::<f32>().unwrap()) < 1e-5);
                assert_eq!((&drawn.tokens, drawn.select_s), (&None, 0.0));
            }
        }
    }

    #[test]
    fn a_frame_of_some_tokens_is_drawn_from_those_the_selector_chooses() {
        for preset in SelectionPreset::ALL {
            let device = Device::flex();
            let (mut viewer, scene, renderer) = viewer(&device, preset);
            let drawn = viewer.draw(&path(4), 16, 24, 5).unwrap();
            let mut selector = Selector::new(preset.rules(), &scene.token_rays()).unwrap();
            for (view, drawn) in path(4).iter().zip(&drawn) {
                let chosen = selector.select(view, 16, 24, 5).unwrap();
                let values = chosen.iter().flat_map(|&id| &scene.tokens[id as usize * 16..][..16]).copied();
                let tokens = TensorData::new(values.collect::<Vec<f32>>(), [1, 5, 16]);
                let cameras = Cameras::of_views(&[*view], 16, 24, &device).unwrap();
                let alone = renderer.forward(Tensor::from_data(tokens, &device), &cameras).into_data();
                assert_eq!(largest_difference(&drawn.pixels, alone.as_slice::<f32>().unwrap()), 0.0);
                assert_eq!(drawn.tokens, Some(chosen));
            }
        }
    }

    #[test]
    fn pictures_have_any_size_that_is_whole_patches() {
        let (mut viewer, ..) = viewer(&Device::flex(), SelectionPreset::Paper);
        for (height, width) in [(8, 8), (32, 48), (16, 64)] {
            let view = camera(0.0, 0.0).resized([16, 24], [height, width]);
            assert_eq!(viewer.frames_per_call(height, width), 8);
            for count in [3, 12] {
                assert_eq!(viewer.draw(&[view], height, width, count).unwrap()[0].pixels.len(), height * width * 3);
            }
        }
    }

    #[test]
    fn fewer_frames_of_large_pictures_are_drawn_at_once() {
        let (viewer, ..) = viewer(&Device::flex(), SelectionPreset::Paper);
        let sizes = [(512, 512), (1024, 1024), (2048, 1024), (1 << 14, 1 << 14), (0, 8)];
        assert_eq!(sizes.map(|(height, width)| viewer.frames_per_call(height, width)), [8, 2, 1, 1, 8]);
    }

    #[test]
    fn only_the_renderer_that_a_scene_was_made_for_draws_it() {
        let device = Device::flex();
        let place = tempfile::tempdir().unwrap();
        let path = place.path().join("model.safetensors");
        let model = Clift::new(&MODEL, 3, &device);
        let scene = scene(&model.renderer);
        file::save_weights(&model, &path).unwrap();
        let renderer = load_renderer(&scene, &path, &device).unwrap();
        assert_eq!(hash::renderer_hash(&renderer, &MODEL), scene.renderer_hash);

        // The weights fit one head as well as two.
        let mut other_heads = scene.clone();
        other_heads.model.num_heads = 1;
        let message = load_renderer(&other_heads, &path, &device).unwrap_err().to_string();
        assert!(message.starts_with("the scene was made for the renderer"), "{message}");

        file::save_weights(&Clift::new(&MODEL, 4, &device), &path).unwrap();
        let message = load_renderer(&scene, &path, &device).unwrap_err().to_string();
        let expected = format!("the scene was made for the renderer {}, this", &scene.renderer_hash[..12]);
        assert!(message.starts_with(&expected) && message.contains("(--model RUN)"), "{message}");

        file::save_weights(&model.encoder, &path).unwrap();
        let mut small = scene.clone();
        small.model.num_renderer_blocks = 1;
        let message = load_renderer(&small, &path, &device).unwrap_err().to_string();
        assert!(message.contains("parameters of the scene's renderer are missing"), "{message}");

        let mut huge = scene;
        huge.model = ModelConfig { dim: 1 << 16, feed_forward_dim: 1 << 18, num_renderer_blocks: 1 << 10, ..MODEL };
        let message = load_renderer(&huge, &path, &device).unwrap_err().to_string();
        assert!(message.contains("the scene's renderer takes 281474976710656 bytes at least"), "{message}");
    }
}
