//! Renders frames of a scene on a device.
// S storage tokens, R rendered tokens, D width

use std::path::Path;
use std::time::Instant;

use burn::tensor::{Device, Tensor, TensorData};
use clift_core::{Camera, Pose, ViewDistance};
use clift_model::{
    Cameras, KeyValueCache, ModelConfig, ModelError, PatchGrids, Renderer, SelectionRules, Selector, TokenRay, Tokens,
    has_threads, map_in_threads, open_renderer, render_bytes, renderer_hash,
};

use crate::scene::frame_size::{FramePlan, TrainedImage};
use crate::scene::scene::{ContextGroup, Scene};

/// Most images of one call, which share keys and values, and most frames that are rendered together.
const IMAGES_PER_CALL: usize = 8;
/// Most patches of one call with several images, or of images by threads side by side: eight images of 512 x 512 pixels.
const PATCHES_PER_CALL: usize = 1 << 15;
/// Most pixels of several frames that are rendered together.
const PIXELS_PER_CALL: usize = 1 << 21;
/// Differences in distance over which groups are blended, in the units of [`ViewDistance`].
const BLEND: f64 = 0.15;
const MAX_BLENDED: usize = 3;
/// Increase of a group's share of a frame, from one half, over which the other half of its patch grids fades in.
const FADE_IN: f64 = 0.15;

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
    let mut num_images = images_per_call(patches);
    if has_threads(true, patches[0] * patches[1]) {
        num_images = num_images.max(rayon::current_num_threads());
    }
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
    /// Seconds from the tokens to the pixels on the host; the mean of the frames of a call.
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

/// The image of one group for a frame, and its share of the frame.
struct Part {
    group: usize,
    frame: usize,
    share: f64,
    plan: FramePlan,
    /// Of selected tokens; `None` for all of the group.
    cache: Option<KeyValueCache>,
    /// Positions in the scene.
    tokens: Vec<u32>,
}

/// An image on one patch grid.
struct GridImage<'a> {
    part: &'a Part,
    camera: Camera,
    grid: usize,
    weight: f32,
    /// Position among all windows of all parts.
    window: usize,
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
    /// of their images with weights that change continuously along a path; of `num_render_tokens`, each group has its share. An
    /// image with at most half of the weight is rendered on half of the patch grids.
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
        let mut select_s = vec![0.0; views.len()];
        let mut parts = Vec::new();
        for (index, group) in self.groups.iter_mut().enumerate() {
            let share = |frame: usize| shares[frame].iter().find(|(other, _)| *other == index).map(|(_, share)| *share);
            let frames: Vec<(usize, f64)> = (0..views.len()).filter_map(|frame| Some((frame, share(frame)?))).collect();
            for &(frame, share) in &frames {
                let started = Instant::now();
                let count = selects.then_some((num_render_tokens as f64 * share).ceil() as usize);
                let (plan, cache, tokens) = group.select(&views[frame], [height, width], count)?;
                parts.push(Part { group: index, frame, share, plan, cache, tokens });
                select_s[frame] += if selects { started.elapsed().as_secs_f64() } else { 0.0 };
            }
            if selects && frames.is_empty() {
                // A group that comes back later starts a path of its own.
                group.selector.reset();
            }
        }
        let started = Instant::now();
        let mut rendered = vec![(vec![0.0; height * width * 3], Vec::new()); views.len()];
        for (part, image) in parts.iter().zip(self.draw(&parts)?) {
            let (pixels, tokens) = &mut rendered[part.frame];
            pixels.iter_mut().zip(image).for_each(|(sum, value)| *sum += part.share as f32 * value);
            tokens.extend_from_slice(&part.tokens);
        }
        let render_s = started.elapsed().as_secs_f64() / views.len() as f64;
        let are_all = !selects && self.groups.len() == 1;
        let view = |((pixels, mut tokens), select_s): ((Vec<f32>, Vec<u32>), f64)| {
            tokens.sort_unstable();
            RenderedView { pixels, tokens: (!are_all).then_some(tokens), select_s, render_s }
        };
        Ok(rendered.into_iter().zip(select_s).map(view).collect())
    }

    /// Draws the images of parts of frames, each the mean of its patch grids, and resamples them.
    fn draw(&self, parts: &[Part]) -> Result<Vec<Vec<f32>>, ModelError> {
        let Some(trained) = self.groups.first().map(|group| group.trained) else { return Ok(Vec::new()) };
        let image_len = trained.size[0] * trained.size[1] * 3;
        let num_patches: usize = trained.patches().iter().product();
        let is_threaded = has_threads(self.device == Device::flex(), num_patches);
        let most = images_per_call(trained.patches());
        let (per_call, at_once) = if is_threaded { (1, PATCHES_PER_CALL / num_patches.max(1)) } else { (most, 1) };
        let num_grids = self.renderer.num_patch_grids();
        let windows = parts.iter().flat_map(|part| part.plan.windows().into_iter().map(move |camera| (part, camera)));
        let windows: Vec<(&Part, Camera)> = windows.collect();
        let image = |grid: usize, window: usize| {
            let (part, camera) = windows[window];
            GridImage { part, camera, grid, weight: grid_weight(grid, num_grids, part.group, part.share), window }
        };
        let on_grid = |grid: usize| (0..windows.len()).map(move |window| image(grid, window));
        let images: Vec<GridImage> = (0..num_grids).flat_map(on_grid).filter(|image| image.weight > 0.0).collect();
        let together = |a: &GridImage, b: &GridImage| {
            let is_same = std::ptr::eq(a.part, b.part);
            let has_all = a.part.group == b.part.group && a.part.cache.is_none() && b.part.cache.is_none();
            a.grid == b.grid && (is_same || has_all)
        };
        let calls: Vec<&[GridImage]> = images.chunk_by(together).flat_map(|images| images.chunks(per_call)).collect();
        let mut pixels = vec![0.0; windows.len() * image_len];
        for calls in calls.chunks(at_once) {
            let drawn = map_in_threads(is_threaded, calls, |images| self.draw_images(images, trained.size))?;
            let values = drawn.iter().flat_map(|images| images.chunks_exact(image_len));
            for (image, values) in calls.iter().copied().flatten().zip(values) {
                let sums = &mut pixels[image.window * image_len..][..image_len];
                sums.iter_mut().zip(values).for_each(|(sum, value)| *sum += image.weight * value);
            }
        }
        let mut rest = &pixels[..];
        let frame = |part: &Part| {
            let (windows, others) = rest.split_at(part.plan.windows().len() * image_len);
            rest = others;
            part.plan.assemble(windows)
        };
        Ok(parts.iter().map(frame).collect())
    }

    /// Draws images from the same tokens on one patch grid.
    fn draw_images(&self, images: &[GridImage], [height, width]: [usize; 2]) -> Result<Vec<f32>, ModelError> {
        let GridImage { part, grid, .. } = images[0];
        let cache = part.cache.as_ref().unwrap_or(&self.groups[part.group].cache);
        let cameras: Vec<Camera> = images.iter().map(|image| image.camera).collect();
        let cameras = Cameras::of_views(&cameras, height, width, &self.device)?;
        let pixels = self.renderer.render_on_grid(cache, &cameras, grid).into_data().convert::<f32>();
        let pixels = pixels.try_to_vec::<f32>().map_err(ModelError::device)?;
        let Some(position) = pixels.iter().position(|value| !value.is_finite()) else { return Ok(pixels) };
        Err(ModelError::NotFinite { name: "a rendering", value: pixels[position], position })
    }
}

impl TokenGroup {
    /// Plans the group's image of a view and selects `num_render_tokens` tokens; returns their keys and values and their
    /// positions in the scene. `None` and as many as the group has are all tokens.
    fn select(
        &mut self,
        view: &Camera,
        size: [usize; 2],
        num_render_tokens: Option<usize>,
    ) -> Result<(FramePlan, Option<KeyValueCache>, Vec<u32>), ModelError> {
        let plan = FramePlan::new(self.trained, &self.context.cameras([*view])[0], size)?;
        let Some(count) = num_render_tokens.filter(|count| *count < self.tokens.len()) else {
            return Ok((plan, None, self.tokens.clone()));
        };
        let (view, [height, width]) = plan.whole();
        let selected = self.selector.select(&view, height, width, count)?;
        let cache = self.cache.select(&selected);
        Ok((plan, Some(cache), selected.into_iter().map(|token| self.tokens[token as usize]).collect()))
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

/// Returns the weight of a patch grid in the image of a group. Up to a share of one half, every second grid has weight 0: the odd
/// grids of groups with an even index, the even grids of the others. They fade in with the share.
fn grid_weight(grid: usize, num_grids: usize, group: usize, share: f64) -> f32 {
    if num_grids == 1 {
        return 1.0;
    }
    let faded_in = ((share - 0.5) / FADE_IN).clamp(0.0, 1.0);
    let weight = if (grid + group).is_multiple_of(2) { 2.0 - faded_in } else { faded_in };
    (weight / num_grids as f64) as f32
}

#[cfg(test)]
mod tests;
