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
use crate::scene::group_shares::group_shares;
use crate::scene::scene::{ContextGroup, MAX_JOINED_VIEWS, Scene};

/// Most images of one call, which share keys and values, and most frames that are rendered together.
const IMAGES_PER_CALL: usize = 8;
/// Most patches of one call with several images: eight images of 512 x 512 pixels.
const PATCHES_PER_CALL: usize = 1 << 15;
/// Most pixels of several frames that are rendered together.
const PIXELS_PER_CALL: usize = 1 << 21;

/// Returns the number of frames of `height` by `width` pixels that are rendered together.
fn frames_per_call(height: usize, width: usize) -> usize {
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
    /// Poses of the context views in the scene.
    views: Vec<Pose>,
    /// Positions of the tokens in the scene.
    tokens: Vec<u32>,
    /// Tokens of every view, where a view is rendered from those of the nearest few; empty otherwise.
    of_views: Vec<Vec<u32>>,
    /// Keys and values of the tokens.
    cache: KeyValueCache,
    selector: Selector,
}

impl SceneRenderer {
    /// Copies a scene's tokens to a device. `renderer` comes from [`load_renderer`], on the same device.
    ///
    /// # Errors
    /// [`ModelError::BadRay`] for a scene with rays that are not finite; [`Scene::read`] returns no such scene.
    pub fn new(scene: &Scene, renderer: Renderer, rules: SelectionRules, device: &Device) -> Result<Self, ModelError> {
        let (rays, dim) = (scene.token_rays(), scene.model.dim);
        let patches_per_view = scene.height / scene.model.patch_size * (scene.width / scene.model.patch_size);
        let is_joined = scene.model.joins_groups() && scene.num_members() > MAX_JOINED_VIEWS;
        let mut groups = Vec::with_capacity(scene.groups.len());
        let mut first_patch = 0;
        for (group, tokens) in scene.render_groups() {
            let rows = tokens.iter().flat_map(|&token| &scene.tokens[token as usize * dim..][..dim]);
            let values = TensorData::new(rows.copied().collect::<Vec<f32>>(), [1, tokens.len(), dim]);
            let context = scene.group_cameras(&group);
            let cameras = Cameras::of_views(&context, scene.height, scene.width, device)?;
            let patches: Vec<u32> = tokens.iter().map(|&token| scene.token_ids[token as usize] - first_patch).collect();
            let values = Tensor::from_data(values, device);
            let rays: Vec<TokenRay> = tokens.iter().filter_map(|&token| rays.get(token as usize)).copied().collect();
            first_patch += (group.views.len() * patches_per_view) as u32;
            groups.push(TokenGroup {
                views: group.views.iter().map(|&view| scene.context[view as usize].c2w).collect(),
                context: group,
                trained: TrainedImage::new(scene, &context),
                cache: renderer.project_tokens(Tokens::of_patches(&scene.model, values, &cameras, &patches)),
                selector: Selector::new(rules, &rays)?,
                of_views: if is_joined { scene.tokens_of_members() } else { Vec::new() },
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

    /// Returns the number of frames of `width` by `height` pixels that are rendered together.
    pub fn frames_per_call(&self, height: usize, width: usize) -> usize {
        frames_per_call(height, width)
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
    /// A network that [joins groups](ModelConfig::joins_groups) has one group of all tokens; a frame is rendered from those of
    /// the eight context views nearest to it.
    /// Frames of all tokens are rendered [`Self::frames_per_call`] at a time. A frame of another size or field of view than
    /// the context views is resampled from images like theirs: it keeps the field of view of its camera, and a larger one has
    /// no more detail.
    ///
    /// # Errors
    /// [`ModelError::NotFinite`] for a camera or an image that is not finite, [`ModelError::BadConfig`] for no tokens, for
    /// fewer learned tokens than all, and for a field of view of more than 64 context views,
    /// [`ModelError::Device`] if an image cannot be read from the device.
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
        let shares: Vec<Vec<(usize, f64)>> = views.iter().map(|view| self.shares(&view.c2w)).collect();
        let mut rendered: Vec<Option<RenderedView>> = vec![None; views.len()];
        for group in 0..self.groups.len() {
            let share = |frame: usize| shares[frame].iter().find(|(other, _)| *other == group).map(|(_, share)| *share);
            let frames: Vec<(usize, f64)> = (0..views.len()).filter_map(|frame| Some((frame, share(frame)?))).collect();
            let is_alone = selects || !self.groups[group].of_views.is_empty();
            let per_call = if is_alone { 1 } else { frames_per_call(height, width) };
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
        let near = tokens.near(self.distance, &views[0].c2w);
        let selected = match (num_render_tokens, near) {
            (Some(count), near) if near.as_ref().is_none_or(|near| count < near.len()) => {
                let (view, size) = plans[0].whole();
                let is_near = near.map(|near| mask(&near, tokens.tokens.len())).unwrap_or_default();
                Some(tokens.selector.select_among(&is_near, &view, size, count)?)
            }
            (_, near) => near,
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

    /// Returns the groups that a view is rendered from, with their shares, which add up to 1.
    fn shares(&self, view: &Pose) -> Vec<(usize, f64)> {
        let distances: Vec<f64> = self.groups.iter().map(|group| self.distance.to_group(view, &group.views)).collect();
        group_shares(&distances)
    }
}

impl TokenGroup {
    /// Returns the tokens of the context views nearest to a view, ascending; `None` for all tokens.
    fn near(&self, distance: ViewDistance, view: &Pose) -> Option<Vec<u32>> {
        if self.of_views.is_empty() {
            return None;
        }
        let to_view = |member: &usize| distance.between(&self.views[*member], view);
        let mut members: Vec<usize> = (0..self.views.len()).collect();
        members.sort_by(|a, b| to_view(a).total_cmp(&to_view(b)));
        let mut near: Vec<u32> =
            members[..MAX_JOINED_VIEWS].iter().flat_map(|&member| &self.of_views[member]).copied().collect();
        near.sort_unstable();
        Some(near)
    }
}

/// Returns whether each of `count` tokens is among `tokens`.
fn mask(tokens: &[u32], count: usize) -> Vec<bool> {
    let mut mask = vec![false; count];
    for &token in tokens {
        mask[token as usize] = true;
    }
    mask
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
