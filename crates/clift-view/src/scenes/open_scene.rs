//! A scene ready to render, with all that the page shows of it.

use burn::tensor::Device;
use clift_core::{Camera, Intrinsics, IntrinsicsNorm, Pose, RgbImage, focus_distance, mean_intrinsics};
use clift_eval::Canvas;
use clift_model::{Renderer, SelectionPreset};
use clift_scene::{Scene, SceneRenderer, TokenCoding};
use serde_json::{Value, json};

use crate::error::ViewError;
use crate::protocol::reply::message;

/// Offered sizes over the size of the context views. A smaller image would take as long.
const SIZE_FACTORS: [usize; 3] = [1, 2, 4];
const MAX_SIDE_PX: usize = 1024;

/// A frame that has a true image and is no context view, and its camera in the normalized frame.
#[derive(Clone, Copy, Debug)]
pub struct TrueFrame {
    pub frame: usize,
    pub c2w: Pose,
}

#[derive(Debug)]
pub struct SceneOrigin {
    /// Position in the list of scenes.
    pub index: usize,
    pub coding: TokenCoding,
    pub file_bytes: u64,
    /// True context images; the contexts are rendered from all tokens if `None`.
    pub context_images: Option<Vec<Canvas>>,
    /// Token of each patch.
    pub clusters: Option<Vec<u32>>,
    pub frames: Vec<TrueFrame>,
    /// Offered numbers of stored tokens, ascending.
    pub storage_counts: Vec<usize>,
    pub encode_command: Option<String>,
    pub render_command: String,
}

#[derive(Debug)]
pub struct OpenScene {
    /// Position in the list of scenes.
    pub index: usize,
    pub scene: Scene,
    /// Cloned for each client, who selects tokens on their own.
    pub renderer: SceneRenderer,
    /// Offered `[width, height]`, ascending.
    pub sizes: Vec<[usize; 2]>,
    pub frames: Vec<TrueFrame>,
    /// The message that shows the scene to the page.
    pub message: Vec<u8>,
}

impl OpenScene {
    /// Copies a scene to a device, and renders its context views if it has no images.
    pub fn new(scene: Scene, renderer: Renderer, origin: SceneOrigin, device: &Device) -> Result<Self, ViewError> {
        let mut renderer = SceneRenderer::new(&scene, renderer, SelectionPreset::default().rules(), device)?;
        let rendered = match &origin.context_images {
            Some(_) => Vec::new(),
            None => renderer.render(&scene.context, scene.height, scene.width, scene.num_tokens())?,
        };
        let rendered = rendered.iter().map(|view| Canvas::from_unit(&view.pixels, scene.height, scene.width));
        let rendered = rendered.collect::<Result<Vec<_>, _>>()?;
        let images: Vec<Vec<u8>> =
            origin.context_images.as_ref().unwrap_or(&rendered).iter().map(png).collect::<Result<_, _>>()?;
        let sizes = sizes(&scene);
        let size = [scene.width, scene.height];
        // The intrinsics of a frame are known when its image is read; until then, the mean of the contexts.
        let mean = mean_intrinsics(&scene.context).unwrap_or(Intrinsics { fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0 });
        let of_frame =
            |frame: &TrueFrame| scene_camera(frame.frame, &Camera { c2w: frame.c2w, intrinsics: mean }, size);
        let context = scene.context.iter().zip(&scene.context_frames);
        let context: Vec<Value> = context.map(|(camera, &frame)| scene_camera(frame as usize, camera, size)).collect();
        let reply = json!({
            "scene": origin.index,
            "key": scene.key,
            "size": size,
            // Offered sizes, the first that of the context views.
            "sizes": sizes,
            "patch": scene.model.patch_size,
            "stored": scene.num_tokens(),
            "storage_counts": origin.storage_counts,
            // Tokens before clustering.
            "num_patches": scene.model.num_patches(scene.num_members(), scene.height, scene.width)?,
            "bytes": origin.file_bytes,
            "tokens": format!("{}, {}", scene.kind, origin.coding),
            // Most tokens of a group of context views, from which a frame is rendered.
            "renderable": renderer.max_render_tokens(),
            // Context view of each member of the groups, and patch of each token, counted over the members.
            "members": scene.groups.iter().flat_map(|group| group.views.clone()).collect::<Vec<_>>(),
            "token_ids": scene.token_ids,
            "clusters": origin.clusters,
            "context": context,
            // Whether the parts are the true context images; a scene file holds no images, its contexts are rendered.
            "has_true_images": origin.context_images.is_some(),
            "frames": origin.frames.iter().map(of_frame).collect::<Vec<_>>(),
            "focus": focus_distance(&scene.context),
            // Mean context camera in the world of the capture, and normalized units per unit of that world.
            "mean_c2w": scene.world.mean_c2w.to_matrix_f64(),
            "scale": scene.world.scale,
            "encode_command": origin.encode_command,
            "render_command": origin.render_command,
        });
        let message = message("scene", reply, &images.iter().map(Vec::as_slice).collect::<Vec<_>>());
        Ok(Self { index: origin.index, scene, renderer, sizes, frames: origin.frames, message })
    }
}

/// Returns a camera for the page, of an image of `[width, height]` pixels: rows of the camera-to-world matrix, and
/// `fx, fy, cx, cy` over width and height.
pub fn scene_camera(frame: usize, camera: &Camera, [width, height]: [usize; 2]) -> Value {
    let c2w = camera.c2w.to_matrix_f64();
    let intrinsics = IntrinsicsNorm::from_pixels(camera.intrinsics, width as f64, height as f64);
    json!({"frame": frame, "c2w": c2w[..12], "intrinsics": intrinsics.to_array()})
}

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
