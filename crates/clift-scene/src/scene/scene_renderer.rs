//! Renders frames of a scene on a device.
// S storage tokens, R rendered tokens, D width

use std::path::Path;
use std::time::Instant;

use burn::tensor::{Device, Tensor, TensorData};
use clift_core::{Camera, Pose, ViewDistance};
use clift_model::{
    Cameras, KeyValueCache, ModelConfig, ModelError, PatchGrids, Renderer, SelectionRules, Selector, TokenRay, Tokens,
    open_renderer, render_bytes, renderer_hash,
};

use crate::scene::frame_size::{FramePlan, TrainedImage};
use crate::scene::scene::{ContextGroup, Scene};

/// Most images of one call, which share keys and values, and most frames that are rendered together.
const IMAGES_PER_CALL: usize = 8;
/// Most patches of one call with several images: eight images of 512 x 512 pixels.
const PATCHES_PER_CALL: usize = 1 << 15;
/// Most pixels of several frames that are rendered together.
const PIXELS_PER_CALL: usize = 1 << 21;
/// Differences in distance over which groups are blended, in the units of [`ViewDistance`].
const BLEND: f64 = 0.15;
const MAX_BLENDED: usize = 3;

/// Returns the number of frames of `height` by `width` pixels that [`SceneRenderer::render`] renders together.
pub fn frames_per_call(height: usize, width: usize) -> usize {
    (PIXELS_PER_CALL / (height * width).max(1)).clamp(1, IMAGES_PER_CALL)
}

/// Returns the number of images of `[rows, columns]` patches that one call renders.
fn images_per_call([rows, columns]: [usize; 2]) -> usize {
    (PATCHES_PER_CALL / (rows * columns).max(1)).clamp(1, IMAGES_PER_CALL)
}

/// Returns the peak bytes of tensors and pixels, without weights, while frames of a scene are rendered with the network
/// `model`.
pub fn frame_bytes(scene: &Scene, model: &ModelConfig, [height, width]: [usize; 2]) -> u64 {
    let patches = TrainedImage::new(scene, &scene.context).patches();
    let num_images = images_per_call(patches);
    let grids = model.patch_grids.patches(model.patch_size, patches);
    let largest = grids.map(|[rows, columns]| rows * columns).max().unwrap_or_default();
    // Three values of four bytes per pixel of the frames, and of one while it is resampled.
    let pixels = ((frames_per_call(height, width) + 2) * height * width * 12) as u64;
    render_bytes(model, scene.max_render_tokens(), num_images, num_images * largest) + pixels
}

/// Reads the renderer of a scene from a weight file.
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
    /// Positions of the tokens that it was rendered from, ascending; `None` for all tokens of the scene.
    pub tokens: Option<Vec<u32>>,
    /// Seconds of token selection.
    pub select_s: f64,
    /// Seconds from the tokens to the pixels on the host; the mean of the frames that are rendered together.
    pub render_s: f64,
}

/// A scene's tokens and renderer on a device, and the token selection of the previous frame. Clones share the tensors and
/// select on their own.
#[derive(Clone, Debug)]
pub struct SceneRenderer {
    renderer: Renderer,
    groups: Vec<TokenGroup>,
    distance: ViewDistance,
    max_render_tokens: usize,
    /// Whether tokens have rays, by which a view selects them.
    has_patch_tokens: bool,
    device: Device,
}

/// The tokens of context views that views are rendered from together.
#[derive(Clone, Debug)]
struct TokenGroup {
    context: ContextGroup,
    trained: TrainedImage,
    views: Vec<Pose>,
    tokens: Vec<u32>,
    cache: KeyValueCache,
    selector: Selector,
}

impl SceneRenderer {
    /// Copies a scene's tokens to a device. `renderer` comes from [`load_renderer`], on the same device.
    pub fn new(scene: &Scene, renderer: Renderer, rules: SelectionRules, device: &Device) -> Result<Self, ModelError> {
        let rays = scene.token_rays();
        let mut groups = Vec::with_capacity(scene.groups.len());
        for (i, (group, tokens)) in scene.groups.iter().zip(scene.tokens_of_groups()).enumerate() {
            let rays: Vec<TokenRay> = tokens.iter().filter_map(|&token| rays.get(token as usize)).copied().collect();
            groups.push(TokenGroup {
                views: group.views.iter().map(|&view| scene.context[view as usize].c2w).collect(),
                context: group.clone(),
                trained: TrainedImage::new(scene, &scene.group_cameras(group)),
                cache: renderer.project_tokens(group_tokens(scene, i, &tokens, device)?),
                selector: Selector::new(rules, &rays)?,
                tokens,
            });
        }
        let context: Vec<Pose> = scene.context.iter().map(|camera| camera.c2w).collect();
        Ok(Self {
            renderer,
            groups,
            distance: ViewDistance::new(&context),
            max_render_tokens: scene.max_render_tokens(),
            has_patch_tokens: scene.model.has_patch_tokens(),
            device: device.clone(),
        })
    }

    /// Returns the most tokens that a frame is rendered from at once ([`Scene::max_render_tokens`]).
    pub fn max_render_tokens(&self) -> usize {
        self.max_render_tokens
    }

    /// Resets token selection: the next frame does not depend on earlier frames.
    pub fn reset(&mut self) {
        self.groups.iter_mut().for_each(|group| group.selector.reset());
    }

    /// Replaces the number of patch grids of a frame, the model's at first.
    pub fn set_patch_grids(&mut self, patch_grids: PatchGrids) {
        self.renderer.set_patch_grids(patch_grids);
    }

    /// Replaces the rules of token selection and resets it.
    pub fn set_rules(&mut self, rules: SelectionRules) {
        self.groups.iter_mut().for_each(|group| group.selector.set_rules(rules));
    }

    /// Renders the next frames of a path from the groups of tokens nearest to each: of every group from the
    /// `num_render_tokens` tokens nearest to the view, or all its tokens if it has no more. A frame between groups is a mean
    /// of their images with weights that change continuously along a path; of `num_render_tokens`, each group has its share.
    /// Frames of all tokens are rendered [`frames_per_call`] at a time. A frame of another size or field of view than
    /// the context views is resampled from images like theirs: it keeps the field of view of its camera, and a larger one has
    /// no more detail.
    pub fn render(
        &mut self,
        views: &[Camera],
        height: usize,
        width: usize,
        num_render_tokens: usize,
    ) -> Result<Vec<RenderedView>, ModelError> {
        let selects = num_render_tokens < self.max_render_tokens;
        if selects && !self.has_patch_tokens {
            let fix = format!(
                "learned tokens belong to no view, so that none can be selected by the camera: render from all {}",
                self.max_render_tokens()
            );
            return Err(ModelError::BadConfig { key: "num_render_tokens", value: num_render_tokens.to_string(), fix });
        }
        let to_group = |view: &Camera, group: &TokenGroup| self.distance.to_group(&view.c2w, &group.views);
        let to_groups = |view: &Camera| self.groups.iter().map(|group| to_group(view, group)).collect::<Vec<_>>();
        let shares: Vec<_> = views.iter().map(|view| group_shares(&to_groups(view))).collect();
        let mut rendered: Vec<Option<RenderedView>> = vec![None; views.len()];
        for group in 0..self.groups.len() {
            let share = |frame: usize| shares[frame].iter().find(|(other, _)| *other == group).map(|(_, share)| *share);
            let frames: Vec<(usize, f64)> = (0..views.len()).filter_map(|frame| Some((frame, share(frame)?))).collect();
            let per_call = if selects { 1 } else { frames_per_call(height, width) };
            for frames in frames.chunks(per_call) {
                let cameras: Vec<Camera> = frames.iter().map(|&(frame, _)| views[frame]).collect();
                let count = (num_render_tokens as f64 * frames[0].1).ceil() as usize;
                let images = self.render_group(group, &cameras, [height, width], selects.then_some(count))?;
                for (&(frame, share), image) in frames.iter().zip(images) {
                    RenderedView::blend(&mut rendered[frame], image, share as f32);
                }
            }
            if selects && frames.is_empty() {
                // A group that comes back later starts a path of its own.
                self.groups[group].selector.reset();
            }
        }
        Ok(rendered.into_iter().flatten().collect())
    }

    /// Renders frames from the tokens of one group: all of them, or selected ones for a single frame.
    fn render_group(
        &mut self,
        group: usize,
        views: &[Camera],
        size: [usize; 2],
        num_render_tokens: Option<usize>,
    ) -> Result<Vec<RenderedView>, ModelError> {
        let started = Instant::now();
        let num_groups = self.groups.len();
        let tokens = &mut self.groups[group];
        let trained = tokens.trained;
        let plan = |view: &Camera| FramePlan::new(trained, view, size);
        let plans: Vec<FramePlan> =
            tokens.context.cameras(views.iter().copied()).iter().map(plan).collect::<Result<_, _>>()?;
        let selected = match num_render_tokens.filter(|count| *count < tokens.tokens.len()) {
            Some(count) => {
                let (view, [height, width]) = plans[0].whole();
                Some(tokens.selector.select(&view, height, width, count)?)
            }
            None => None,
        };
        let select_s = if selected.is_some() { started.elapsed().as_secs_f64() } else { 0.0 };
        let started = Instant::now();
        let cache = selected.as_ref().map(|selected| tokens.cache.select(selected));
        let in_scene = match selected {
            Some(selected) => Some(selected.into_iter().map(|token| tokens.tokens[token as usize]).collect()),
            // All tokens of a scene with one group.
            None if num_groups == 1 => None,
            None => Some(tokens.tokens.clone()),
        };
        let frames = self.draw(cache.as_ref().unwrap_or(&self.groups[group].cache), trained, &plans)?;
        let render_s = started.elapsed().as_secs_f64() / plans.len() as f64;
        let view = |pixels| RenderedView { pixels, tokens: in_scene.clone(), select_s, render_s };
        Ok(frames.into_iter().map(view).collect())
    }

    /// Draws the windows of frames from keys and values of tokens, [`images_per_call`] at a time, and resamples them.
    fn draw(
        &self,
        cache: &KeyValueCache,
        trained: TrainedImage,
        plans: &[FramePlan],
    ) -> Result<Vec<Vec<f32>>, ModelError> {
        let windows: Vec<Camera> = plans.iter().flat_map(FramePlan::windows).collect();
        let [height, width] = trained.size;
        let mut pixels = Vec::with_capacity(windows.len() * height * width * 3);
        for windows in windows.chunks(images_per_call(trained.patches())) {
            let cameras = Cameras::of_views(windows, height, width, &self.device)?;
            let images = self.renderer.render_cached(cache, &cameras).into_data().convert::<f32>();
            pixels.extend(images.try_to_vec::<f32>().map_err(ModelError::device)?);
        }
        if let Some(position) = pixels.iter().position(|value| !value.is_finite()) {
            return Err(ModelError::NotFinite { name: "a rendering", value: pixels[position], position });
        }
        let mut rest = &pixels[..];
        let frame = |plan: &FramePlan| {
            let (windows, others) = rest.split_at(plan.windows().len() * height * width * 3);
            rest = others;
            plan.assemble(windows)
        };
        Ok(plans.iter().map(frame).collect())
    }
}

/// Copies the tokens of group `i`, which are at these positions, to a device, with the transforms of their patches.
///
/// # Shapes
/// - returns `[1, positions, D]`
pub(crate) fn group_tokens(scene: &Scene, i: usize, positions: &[u32], device: &Device) -> Result<Tokens, ModelError> {
    let Scene { ref model, height, width, .. } = *scene;
    let rows = positions.iter().flat_map(|&token| &scene.tokens[token as usize * model.dim..][..model.dim]);
    let rows = TensorData::new(rows.copied().collect::<Vec<f32>>(), [1, positions.len(), model.dim]);
    let members_before: usize = scene.groups[..i].iter().map(|group| group.views.len()).sum();
    let first_patch = (members_before * (height / model.patch_size) * (width / model.patch_size)) as u32;
    let patches: Vec<u32> = positions.iter().map(|&token| scene.token_ids[token as usize] - first_patch).collect();
    let cameras = Cameras::of_views(&scene.group_cameras(&scene.groups[i]), height, width, device)?;
    Ok(Tokens::of_patches(model, Tensor::from_data(rows, device), &cameras, &patches))
}

/// Returns the nearest groups and their shares of a frame, which add up to 1 and change continuously with the distances: a
/// share falls linearly to 0 where a group is [`BLEND`] farther than the nearest, or as far as the next after
/// [`MAX_BLENDED`].
pub(crate) fn group_shares(distances: &[f64]) -> Vec<(usize, f64)> {
    let mut order: Vec<usize> = (0..distances.len()).collect();
    order.sort_by(|&a, &b| distances[a].total_cmp(&distances[b]));
    let Some(&nearest) = order.first() else { return Vec::new() };
    let limit = distances[nearest] + BLEND;
    let limit = order.get(MAX_BLENDED).map_or(limit, |&next| limit.min(distances[next]));
    let rooms = order.into_iter().take(MAX_BLENDED).map(|group| (group, limit - distances[group]));
    let mut near: Vec<(usize, f64)> = rooms.filter(|(_, room)| *room > 0.0).collect();
    if near.is_empty() {
        return vec![(nearest, 1.0)];
    }
    let sum: f64 = near.iter().map(|(_, room)| room).sum();
    for (_, room) in &mut near {
        *room /= sum;
    }
    near
}

impl RenderedView {
    /// Adds an image with its share of the frame.
    fn blend(frame: &mut Option<Self>, mut image: Self, share: f32) {
        image.pixels.iter_mut().for_each(|value| *value *= share);
        let Some(frame) = frame else {
            *frame = Some(image);
            return;
        };
        frame.pixels.iter_mut().zip(&image.pixels).for_each(|(sum, value)| *sum += value);
        frame.select_s += image.select_s;
        frame.render_s += image.render_s;
        if let (Some(tokens), Some(more)) = (&mut frame.tokens, image.tokens) {
            tokens.extend(more);
            tokens.sort_unstable();
        }
    }
}

#[cfg(test)]
mod tests;
