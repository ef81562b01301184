//! Renders frames of a scene on a device.
// S storage tokens, R rendered tokens, D width

use std::path::Path;
use std::time::Instant;

use burn::tensor::{Device, Tensor, TensorData};
use clift_core::Camera;
use clift_model::{
    Cameras, KeyValueCache, ModelConfig, ModelError, PatchGrids, Renderer, SelectionRules, Selector, Tokens,
    interleaved, open_renderer, phases, render_bytes, renderer_hash,
};

use crate::scene::scene::Scene;

/// Most frames of one call with all tokens, where frames share keys and values.
const FRAMES_PER_CALL: usize = 8;
/// Most patches of one call with several frames: eight frames of 512 x 512 pixels.
const PATCHES_PER_CALL: usize = 1 << 15;

/// Returns the number of frames of `num_patches` patches that one call renders.
pub fn frames_per_call(num_patches: usize) -> usize {
    (PATCHES_PER_CALL / num_patches.max(1)).clamp(1, FRAMES_PER_CALL)
}

/// Returns the peak bytes of tensors, without weights, while one call renders frames of a scene with the network `model`.
pub fn frame_bytes(scene: &Scene, model: &ModelConfig, num_frames: usize, [height, width]: [usize; 2]) -> u64 {
    let (k, size) = phases(scene.height, model.patch_size, [height, width]);
    let grids = model.patch_grids.patches(model.patch_size, size.map(|side| side / model.patch_size));
    let largest = grids.map(|[rows, columns]| rows * columns).max().unwrap_or_default();
    let num_images = k * k * num_frames;
    render_bytes(model, scene.num_tokens(), num_images, num_images * largest)
}

/// Reads the renderer of a scene from a weight file.
///
/// # Errors
/// [`ModelError::Weights`] for a file that cannot be read or lacks parameters of the renderer,
/// [`ModelError::OtherRenderer`] for other weights than those of the scene.
pub fn load_renderer(scene: &Scene, weights: &Path, device: &Device) -> Result<Renderer, ModelError> {
    let renderer = open_renderer(&scene.model, weights, device)?;
    let got = renderer_hash(&renderer, &scene.model);
    if got != scene.renderer_hash {
        return Err(ModelError::OtherRenderer { expected: scene.renderer_hash.clone(), got, path: weights.into() });
    }
    Ok(renderer)
}

/// A rendered frame.
#[derive(Clone, Debug, PartialEq)]
pub struct RenderedView {
    /// RGB in `(0, 1)`, `[height, width, 3]`.
    pub pixels: Vec<f32>,
    /// Indices of the selected tokens, ascending; `None` for all tokens.
    pub tokens: Option<Vec<u32>>,
    /// Seconds of token selection.
    pub select_s: f64,
    /// Seconds from the tokens to the pixels on the host; the mean of the frames of one call.
    pub render_s: f64,
}

/// A scene's tokens and renderer on a device, and the token selection of the previous frame. Clones share the tensors and
/// select on their own.
#[derive(Clone, Debug)]
pub struct SceneRenderer {
    renderer: Renderer,
    /// Keys and values of all storage tokens.
    cache: KeyValueCache,
    selector: Selector,
    /// Whether tokens have rays, by which a view selects them.
    has_patch_tokens: bool,
    /// Rows of the images that the network was trained on.
    trained_height: usize,
    device: Device,
}

impl SceneRenderer {
    /// Copies a scene's tokens to a device. `renderer` comes from [`load_renderer`], on the same device.
    ///
    /// # Errors
    /// [`ModelError::BadRay`] for a scene with rays that are not finite; [`Scene::read`] returns no such scene.
    pub fn new(scene: &Scene, renderer: Renderer, rules: SelectionRules, device: &Device) -> Result<Self, ModelError> {
        let shape = [1, scene.num_tokens(), scene.model.dim];
        let values = Tensor::from_data(TensorData::new(scene.tokens.clone(), shape), device);
        let context = Cameras::of_views(&scene.context, scene.height, scene.width, device)?;
        let tokens = Tokens::of_patches(&scene.model, values, &context, &scene.token_ids);
        let selector = Selector::new(rules, &scene.token_rays())?;
        let cache = renderer.project_tokens(tokens);
        let (has_patch_tokens, trained_height) = (scene.model.has_patch_tokens(), scene.height);
        Ok(Self { renderer, cache, selector, has_patch_tokens, trained_height, device: device.clone() })
    }

    /// Returns the number of the scene's tokens.
    pub fn num_storage_tokens(&self) -> usize {
        self.cache.num_tokens()
    }

    /// Returns the number of frames of `width` by `height` pixels that one call renders.
    pub fn frames_per_call(&self, height: usize, width: usize) -> usize {
        let patch_size = self.renderer.patch_size();
        frames_per_call(height / patch_size * (width / patch_size))
    }

    /// Resets token selection: the next frame does not depend on earlier frames.
    pub fn reset(&mut self) {
        self.selector.reset();
    }

    /// Replaces the number of patch grids of a frame, the model's at first.
    pub fn set_patch_grids(&mut self, patch_grids: PatchGrids) {
        self.renderer.set_patch_grids(patch_grids);
    }

    /// Replaces the rules of token selection and resets it.
    pub fn set_rules(&mut self, rules: SelectionRules) {
        self.selector.set_rules(rules);
    }

    /// Renders the next frames of a path, each from its own selection of `num_render_tokens` tokens, or from all tokens if
    /// the scene has no more. Frames of all tokens are rendered [`Self::frames_per_call`] at a time. Frames larger than the
    /// context views are interleaved from several of about their size: smooth, but without more detail.
    ///
    /// # Errors
    /// [`ModelError::NotFinite`] for a camera or an image that is not finite, [`ModelError::BadConfig`] for no tokens, and for
    /// fewer learned tokens than all,
    /// [`ModelError::Device`] if an image cannot be read from the device.
    ///
    /// # Panics
    /// If a side is not a multiple of the patch.
    pub fn render(
        &mut self,
        views: &[Camera],
        height: usize,
        width: usize,
        num_render_tokens: usize,
    ) -> Result<Vec<RenderedView>, ModelError> {
        let mut rendered = Vec::with_capacity(views.len());
        if num_render_tokens < self.num_storage_tokens() && !self.has_patch_tokens {
            let fix = format!(
                "learned tokens belong to no view, so that none can be selected by the camera: render from all {}",
                self.num_storage_tokens()
            );
            return Err(ModelError::BadConfig { key: "num_render_tokens", value: num_render_tokens.to_string(), fix });
        }
        if num_render_tokens >= self.num_storage_tokens() {
            for views in views.chunks(self.frames_per_call(height, width)) {
                rendered.extend(self.render_call(views, height, width, None, 0.0)?);
            }
            return Ok(rendered);
        }
        for view in views {
            let started = Instant::now();
            let selected = self.selector.select(view, height, width, num_render_tokens)?;
            let select_s = started.elapsed().as_secs_f64();
            rendered.extend(self.render_call(&[*view], height, width, Some(selected), select_s)?);
        }
        Ok(rendered)
    }

    fn render_call(
        &self,
        views: &[Camera],
        height: usize,
        width: usize,
        selected: Option<Vec<u32>>,
        select_s: f64,
    ) -> Result<Vec<RenderedView>, ModelError> {
        let started = Instant::now();
        let cameras = Cameras::of_views(views, height, width, &self.device)?;
        let some = selected.as_ref().map(|selected| self.cache.select(selected));
        let cache = some.as_ref().unwrap_or(&self.cache);
        let draw = |cameras: &Cameras| self.renderer.render_cached(cache, cameras);
        let images = interleaved(self.trained_height, self.renderer.patch_size(), &cameras, draw);
        let images = images.into_data().convert::<f32>();
        let pixels = images.try_to_vec::<f32>().map_err(ModelError::device)?;
        let render_s = started.elapsed().as_secs_f64() / views.len() as f64;
        if let Some(position) = pixels.iter().position(|value| !value.is_finite()) {
            return Err(ModelError::NotFinite { name: "a rendering", value: pixels[position], position });
        }
        let frames = pixels.chunks_exact(height * width * 3);
        Ok(frames
            .map(|pixels| RenderedView { pixels: pixels.to_vec(), tokens: selected.clone(), select_s, render_s })
            .collect())
    }
}

#[cfg(test)]
mod tests {
    use clift_model::{CameraEncoding, Clift, SelectionPreset, save_weights};

    use super::*;
    use crate::scene::scene::tests::{camera, scene};
    use crate::testing::devices;

    fn config() -> ModelConfig {
        encoded(CameraEncoding::Plucker)
    }

    fn encoded(camera_encoding: CameraEncoding) -> ModelConfig {
        ModelConfig {
            camera_encoding,
            dim: 16,
            num_heads: 2,
            feed_forward_dim: 24,
            num_encoder_blocks: 1,
            num_renderer_blocks: 2,
            ..ModelConfig::default()
        }
    }

    /// A scene with all 12 tokens of two views of 24 x 16 pixels.
    fn whole_scene(renderer: &Renderer, config: &ModelConfig) -> Scene {
        let tokens = (0..12 * 16).map(|i| ((i * 37 % 101) as f32 - 50.0) * 0.02).collect();
        let renderer_hash = renderer_hash(renderer, config);
        Scene { model: config.clone(), renderer_hash, tokens, token_ids: (0..12).collect(), ..scene() }
    }

    fn path(num_frames: usize) -> Vec<Camera> {
        (0..num_frames).map(|i| camera(-0.5 + 0.1 * i as f64, 0.1 - 0.02 * i as f64)).collect()
    }

    fn assert_equals_single_frames(
        device: &Device,
        config: &ModelConfig,
        preset: SelectionPreset,
        count: usize,
        tolerance: f32,
    ) {
        let renderer = Clift::new(config, 3, device).renderer;
        let scene = whole_scene(&renderer, config);
        let context = Cameras::of_views(&scene.context, scene.height, scene.width, device).unwrap();
        let mut scene_renderer = SceneRenderer::new(&scene, renderer.clone(), preset.rules(), device).unwrap();
        let mut selector = Selector::new(preset.rules(), &scene.token_rays()).unwrap();
        let rendered = scene_renderer.render(&path(11), 16, 24, count).unwrap();
        assert_eq!(rendered.len(), 11);
        for (view, rendered) in path(11).iter().zip(&rendered) {
            let selected = (count < 12).then(|| selector.select(view, 16, 24, count).unwrap());
            assert_eq!(rendered.tokens, selected);
            let ids = selected.unwrap_or_else(|| (0..12).collect());
            let values = ids.iter().flat_map(|&id| &scene.tokens[id as usize * 16..][..16]).copied();
            let values = TensorData::new(values.collect::<Vec<f32>>(), [1, count, 16]);
            let tokens = Tokens::of_patches(config, Tensor::from_data(values, device), &context, &ids);
            let cameras = Cameras::of_views(&[*view], 16, 24, device).unwrap();
            let alone = renderer.forward(tokens, &cameras).into_data().convert::<f32>();
            let alone = alone.as_slice::<f32>().unwrap();
            assert_eq!(alone.len(), rendered.pixels.len());
            let error = rendered.pixels.iter().zip(alone).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(error <= tolerance, "{error} with {count} tokens");
        }
    }

    #[test]
    fn frames_equal_images_of_their_tokens_alone() {
        for config in CameraEncoding::ALL.map(encoded) {
            for device in devices() {
                // Matrix products of eight views have other block sizes than those of one view.
                assert_equals_single_frames(&device, &config, SelectionPreset::Paper, 12, 1e-5);
            }
            for &preset in SelectionPreset::ALL {
                assert_equals_single_frames(&Device::flex(), &config, preset, 5, 0.0);
            }
        }
    }

    #[test]
    fn every_second_pixel_of_a_frame_of_twice_the_size_is_a_frame_of_the_trained_size() {
        let device = Device::flex();
        let config = ModelConfig { patch_grids: PatchGrids::Four, ..encoded(CameraEncoding::Gta) };
        let renderer = Clift::new(&config, 3, &device).renderer;
        let scene = whole_scene(&renderer, &config);
        let mut scene_renderer =
            SceneRenderer::new(&scene, renderer, SelectionPreset::default().rules(), &device).unwrap();
        let [large, small] = [camera(0.1, 0.2).resized([16, 24], [32, 48]), camera(0.1, 0.2)];
        let large = scene_renderer.render(&[large], 32, 48, 12).unwrap().remove(0).pixels;
        for (row, column) in [(0, 0), (1, 0), (1, 1)] {
            // Pixel (0, 0) of the large frame is a quarter of a small pixel above and left of the small one's center.
            let shift = |phase: usize| 0.25 - 0.5 * phase as f64;
            let mut view = small;
            view.intrinsics.cx += shift(column);
            view.intrinsics.cy += shift(row);
            let alone = scene_renderer.render(&[view], 16, 24, 12).unwrap().remove(0).pixels;
            for (i, expected) in alone.as_chunks::<3>().0.iter().enumerate() {
                let at = 3 * ((2 * (i / 24) + row) * 48 + 2 * (i % 24) + column);
                let error = large[at..at + 3].iter().zip(expected).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
                assert!(error < 1e-5, "{error} at pixel {i} of phase {row}, {column}");
            }
        }
    }

    #[test]
    fn larger_frames_are_fewer_per_call() {
        let patches = |height: usize, width: usize| height / 8 * (width / 8);
        let sizes = [(512, 512), (1024, 1024), (2048, 1024), (1 << 14, 1 << 14), (0, 8)];
        assert_eq!(sizes.map(|(height, width)| frames_per_call(patches(height, width))), [8, 2, 1, 1, 8]);
    }

    #[test]
    fn a_scene_accepts_only_its_own_renderer() {
        let device = Device::flex();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("model.safetensors");
        let model = Clift::new(&config(), 3, &device);
        let scene = whole_scene(&model.renderer, &config());
        save_weights(&model, &path).unwrap();
        let renderer = load_renderer(&scene, &path, &device).unwrap();
        assert_eq!(renderer_hash(&renderer, &config()), scene.renderer_hash);
        let assert_refused = |change: fn(&mut ModelConfig), expected: &str| {
            let mut scene = scene.clone();
            change(&mut scene.model);
            let message = load_renderer(&scene, &path, &device).unwrap_err().to_string();
            assert!(message.contains(expected), "{message}");
        };
        // The weights have the same shapes with one head as with two.
        let expected = format!("the scene was made for the renderer {}, this", &scene.renderer_hash[..12]);
        assert_refused(|model| model.num_heads = 1, &expected);
        // The same holds for camera-relative attention, which has no weights.
        assert_refused(|model| model.camera_encoding = CameraEncoding::Gta, &expected);
        save_weights(&Clift::new(&config(), 4, &device), &path).unwrap();
        assert_refused(|_| (), &expected);
        save_weights(&model.encoder, &path).unwrap();
        assert_refused(|model| model.num_renderer_blocks = 1, "parameters of the scene's renderer are missing");
        assert_refused(
            |model| (model.dim, model.feed_forward_dim, model.num_renderer_blocks) = (1 << 16, 1 << 18, 1 << 10),
            "the scene's renderer needs at least 14074",
        );
    }
}
