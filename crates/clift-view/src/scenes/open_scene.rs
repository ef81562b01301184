//! A scene ready to render, with all that the page shows of it.

use burn::tensor::Device;
use clift_core::{Camera, Intrinsics, IntrinsicsNorm, RgbImage, focus_distance, mean_intrinsics};
use clift_eval::Canvas;
use clift_model::{Renderer, SelectionPreset};
use clift_scene::{Scene, SceneRenderer, TokenCoding};

use crate::error::ViewError;
use crate::protocol::reply::{OpenedScene, Reply, SceneCamera};
use crate::scenes::true_frames::TrueFrame;

/// Offered sizes over the size of the context views. A smaller image would take as long.
const SIZE_FACTORS: [usize; 3] = [1, 2, 4];
const MAX_SIDE_PX: usize = 1024;

/// Origin of a scene's images, clusters and counts.
#[derive(Debug)]
pub struct SceneOrigin {
    /// Position in the list of scenes.
    pub index: usize,
    pub coding: TokenCoding,
    /// Bytes of the scene's file.
    pub file_bytes: u64,
    /// Context images; rendered from all tokens if `None`.
    pub context_images: Option<Vec<Canvas>>,
    /// Token of each patch.
    pub clusters: Option<Vec<u32>>,
    pub frames: Vec<TrueFrame>,
    /// Offered numbers of stored tokens, ascending.
    pub storage_counts: Vec<usize>,
    pub encode_command: Option<String>,
    pub render_command: String,
}

/// A scene on a device.
#[derive(Debug)]
pub struct OpenScene {
    pub scene: Scene,
    /// Cloned for each client, who selects tokens on their own.
    pub renderer: SceneRenderer,
    /// Offered `[width, height]`, ascending.
    pub sizes: Vec<[usize; 2]>,
    pub origin: SceneOrigin,
    context_images: Vec<Canvas>,
}

impl OpenScene {
    /// Copies a scene to a device, and renders its context views if it has no images.
    pub fn new(scene: Scene, renderer: Renderer, mut origin: SceneOrigin, device: &Device) -> Result<Self, ViewError> {
        let mut renderer = SceneRenderer::new(&scene, renderer, SelectionPreset::default().rules(), device)?;
        let context_images = if let Some(images) = origin.context_images.take() {
            images
        } else {
            let views = renderer.render(&scene.context, scene.height, scene.width, scene.num_tokens())?;
            let images = views.iter().map(|view| Canvas::from_unit(&view.pixels, scene.height, scene.width));
            images.collect::<Result<_, _>>()?
        };
        Ok(Self { sizes: sizes(&scene), scene, renderer, origin, context_images })
    }

    /// Returns the message that shows the scene to the page.
    pub fn reply(&self, has_true_images: bool) -> Result<Vec<u8>, ViewError> {
        let Self { scene, origin, sizes, .. } = self;
        let images: Vec<Vec<u8>> = self.context_images.iter().map(png).collect::<Result<_, _>>()?;
        let size = [scene.width, scene.height];
        // The intrinsics of a frame are known when its image is read; until then, the mean of the contexts.
        let mean = mean_intrinsics(&scene.context).unwrap_or(Intrinsics { fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0 });
        let of_frame =
            |frame: &TrueFrame| scene_camera(frame.frame, &Camera { c2w: frame.c2w, intrinsics: mean }, size);
        let context_frames = scene.context.iter().zip(&scene.context_frames);
        let reply = OpenedScene {
            scene: origin.index,
            key: &scene.key,
            size,
            sizes,
            patch: scene.model.patch_size,
            stored: scene.num_tokens(),
            storage_counts: &origin.storage_counts,
            num_patches: scene.model.num_patches(scene.num_members(), scene.height, scene.width)?,
            bytes: origin.file_bytes,
            tokens: format!("{}, {}", scene.kind, origin.coding),
            renderable: self.renderer.max_render_tokens(),
            members: scene.groups.iter().flat_map(|group| group.views.clone()).collect(),
            token_ids: &scene.token_ids,
            clusters: origin.clusters.as_deref(),
            context: context_frames.map(|(camera, &frame)| scene_camera(frame as usize, camera, size)).collect(),
            has_true_images,
            frames: origin.frames.iter().map(of_frame).collect(),
            focus: focus_distance(&scene.context),
            mean_c2w: scene.world.mean_c2w.to_matrix_f64(),
            scale: scene.world.scale,
            encode_command: origin.encode_command.clone(),
            render_command: origin.render_command.clone(),
        };
        Ok(Reply::Scene(Box::new(reply)).to_bytes(&images.iter().map(Vec::as_slice).collect::<Vec<_>>()))
    }
}

/// Returns a camera for the page, of an image of `[width, height]` pixels.
pub fn scene_camera(frame: usize, camera: &Camera, [width, height]: [usize; 2]) -> SceneCamera {
    let mut c2w = [0.0; 12];
    c2w.copy_from_slice(&camera.c2w.to_matrix_f64()[..12]);
    let intrinsics = IntrinsicsNorm::from_pixels(camera.intrinsics, width as f64, height as f64);
    SceneCamera { frame, c2w, intrinsics: intrinsics.to_array() }
}

/// Encodes an image as PNG.
pub fn png(image: &Canvas) -> Result<Vec<u8>, ViewError> {
    let rgb = image.as_rgb8().to_vec();
    let image = RgbImage { width: image.width(), height: image.height(), rgb };
    Ok(clift_data::encode_png(&image)?)
}

/// Returns the offered sizes, the first that of the context views.
fn sizes(scene: &Scene) -> Vec<[usize; 2]> {
    let own = [scene.width, scene.height];
    let sizes = SIZE_FACTORS.map(|factor| own.map(|side| factor * side)).into_iter();
    sizes.filter(|size| *size == own || size.iter().all(|side| *side <= MAX_SIDE_PX)).collect()
}
