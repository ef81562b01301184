//! The thread that owns the device: opens scenes, renders views, compares true frames.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Instant;

use burn::tensor::Device;
use clift_core::{Camera, RgbImage};
use clift_data::{encode_jpeg, encode_png};
use clift_eval::Canvas;
use clift_model::{PatchGrids, SelectionPreset, psnr};
use clift_scene::SceneRenderer;
use serde_json::json;

use crate::error::ViewError;
use crate::protocol::reply::message;
use crate::protocol::request::{CompareRequest, OpenRequest, ViewRequest};
use crate::scenes::open_scene::{OpenScene, png, scene_camera};
use crate::scenes::scene_set::SceneSet;
use crate::session::clients::{ClientId, Clients, Job};
use crate::session::frame_budget::{FrameBudget, FrameSettings};

/// Scenes that stay on the device without a client.
const KEPT_SCENES: usize = 3;

/// JPEG quality of the frames while the camera moves.
const JPEG_QUALITY: u8 = 90;

pub struct RenderLoop {
    scenes: SceneSet,
    device: Device,
    /// The scenes opened last, the latest at the end.
    open: Vec<Arc<OpenScene>>,
    views: HashMap<ClientId, ClientView>,
    /// The true image read last, with its scene and frame.
    true_image: Option<([usize; 2], (Canvas, Camera))>,
}

/// The scene of a client, and the token selection and time of its previous frames.
struct ClientView {
    scene: Arc<OpenScene>,
    renderer: SceneRenderer,
    selection: SelectionPreset,
    budget: FrameBudget,
}

impl RenderLoop {
    pub fn new(scenes: SceneSet, device: Device) -> Self {
        Self { scenes, device, open: Vec::new(), views: HashMap::new(), true_image: None }
    }

    /// Works until the clients are closed.
    pub fn run(mut self, clients: &Clients) {
        while let Some((id, job)) = clients.next_job() {
            let frame = if let Job::View(request) = &job { Some(request.seq) } else { None };
            let result = match job {
                Job::Forget => {
                    self.views.remove(&id);
                    continue;
                }
                Job::Open(request) => self.open(id, request),
                Job::View(request) => self.view(id, &request),
                Job::Compare(request) => self.compare(id, &request),
            };
            match result {
                Ok(reply) => clients.send(id, reply, frame),
                Err(error) => clients.send(id, message("failure", json!({"message": error.to_string()}), &[]), None),
            }
        }
    }

    fn open(&mut self, id: ClientId, request: OpenRequest) -> Result<Vec<u8>, ViewError> {
        let is_wanted = |open: &Arc<OpenScene>| {
            open.index == request.scene && request.stored.is_none_or(|stored| stored == open.scene.num_tokens())
        };
        let scene = match self.open.iter().position(is_wanted) {
            Some(position) => self.open.remove(position),
            None => Arc::new(self.scenes.open(request, &self.device)?),
        };
        if self.open.len() >= KEPT_SCENES {
            self.open.remove(0);
        }
        self.open.push(scene.clone());
        let reply = scene.message.clone();
        let (renderer, selection) = (scene.renderer.clone(), SelectionPreset::default());
        let budget = self.views.get(&id).map_or_else(FrameBudget::default, |view| view.budget);
        self.views.insert(id, ClientView { scene, renderer, selection, budget });
        Ok(reply)
    }

    fn view(&mut self, id: ClientId, request: &ViewRequest) -> Result<Vec<u8>, ViewError> {
        let begun = Instant::now();
        let ClientView { scene, renderer, selection, budget } = self.views.get_mut(&id).ok_or(ViewError::NoScene)?;
        let stored = scene.scene.num_tokens();
        let wanted =
            FrameSettings { tokens: request.tokens.clamp(1, stored), size: request.size.min(scene.sizes.len() - 1) };
        let budget_s = request.budget_ms.filter(|_| !request.rest).map(|ms| ms.max(1.0) / 1e3);
        let FrameSettings { tokens, size } = budget_s.map_or(wanted, |_| budget.reduce(wanted));
        if *selection != request.selection {
            *selection = request.selection;
            renderer.set_rules(selection.rules());
        }
        if request.rest {
            // The picture at rest depends on the camera alone, like the first frame of `clift render`.
            renderer.reset();
        }
        // One grid of patches is enough while the camera moves.
        renderer.set_patch_grids(if request.rest { scene.scene.model.patch_grids } else { PatchGrids::One });
        let [width, height] = scene.sizes[size];
        let _precision = request.precision.scope();
        let view = renderer.render(&[request.camera([width, height])], height, width, tokens)?.remove(0);
        let started = Instant::now();
        let rgb = Canvas::from_unit(&view.pixels, height, width)?.as_rgb8().to_vec();
        let image = RgbImage { width, height, rgb };
        let picture = if request.rest { encode_png(&image)? } else { encode_jpeg(&image, JPEG_QUALITY)? };
        let frame = json!({
            "seq": request.seq,
            "rest": request.rest,
            "format": if request.rest { "png" } else { "jpeg" },
            "size": [width, height],
            "tokens": view.tokens.as_ref().map_or(stored, Vec::len),
            "stored": stored,
            "select_ms": 1e3 * view.select_s,
            "render_ms": 1e3 * view.render_s,
            "encode_ms": 1e3 * started.elapsed().as_secs_f64(),
        });
        let bits = if request.list_tokens { token_bits(view.tokens.as_deref(), stored) } else { Vec::new() };
        if let Some(budget_s) = budget_s {
            budget.record(begun.elapsed().as_secs_f64(), budget_s, wanted);
        }
        Ok(message("frame", frame, &[&bits, &picture]))
    }

    fn compare(&mut self, id: ClientId, request: &CompareRequest) -> Result<Vec<u8>, ViewError> {
        let scene = self.views.get(&id).ok_or(ViewError::NoScene)?.scene.clone();
        let key = [scene.index, request.frame];
        let (image, camera) = match self.true_image.take().filter(|(kept, _)| *kept == key) {
            Some((_, read)) => read,
            None => self.scenes.true_image(&scene, request.frame)?,
        };
        let [width, height] = [scene.scene.width, scene.scene.height];
        let tokens = request.tokens.clamp(1, scene.scene.num_tokens());
        let mut renderer = scene.renderer.clone();
        renderer.set_rules(request.selection.rules());
        let _precision = request.precision.scope();
        let view = renderer.render(&[camera], height, width, tokens)?.remove(0);
        let target: Vec<f32> = image.as_rgb8().iter().map(|&value| f32::from(value) / 255.0).collect();
        let comparison = json!({
            "frame": request.frame,
            "camera": scene_camera(scene.frames[request.frame].frame, &camera, [width, height]),
            "tokens": tokens,
            // JSON cannot represent infinity.
            "psnr": psnr(&view.pixels, &target)?.min(100.0),
        });
        let true_png = if request.image { vec![png(&image)?] } else { Vec::new() };
        let parts: Vec<&[u8]> = true_png.iter().map(Vec::as_slice).collect();
        self.true_image = Some((key, (image, camera)));
        Ok(message("comparison", comparison, &parts))
    }
}

/// Returns one bit per stored token, the lowest first; all ones for all tokens.
fn token_bits(tokens: Option<&[u32]>, stored: usize) -> Vec<u8> {
    let Some(tokens) = tokens else { return vec![0xff; stored.div_ceil(8)] };
    let mut bits = vec![0; stored.div_ceil(8)];
    for &token in tokens {
        bits[token as usize / 8] |= 1 << (token % 8);
    }
    bits
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn selected_tokens_are_bits() {
        assert_eq!(token_bits(Some(&[0, 9, 10]), 11), [1, 6]);
        assert_eq!(token_bits(None, 11), [0xff, 0xff]);
    }
}
