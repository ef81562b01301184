//! The sweep: every scene encoded once, rendered with every variant at every token count.

use std::time::Instant;

use burn::tensor::{Device, Tensor};
use clift_data::order::derive_seed;
use clift_data::{Clip, Views as HostViews};
use clift_model::scene::file_bytes;
use clift_model::{Cameras, Condenser, Encoder, Grouping, KMeans, Renderer, TokenStorage, total_variance};

use crate::EvalError;
use crate::exhibit::{Material, Shown, sheet_rows};
use crate::measured::{Accumulator, Setting, Variant};
use crate::rendered::{Rendered, baselines};
use crate::selection::{Chosen, Selection};
use crate::stored::{GroupsOnce, Stored, rows_of};
use crate::token_count::TokenCount;
use crate::upload::{upload_cameras, upload_views};

/// Target views rendered at once: bounds memory for clips with a hundred targets.
const VIEWS_PER_PASS: usize = 8;

/// The networks of an evaluation, on a device without autodiff.
#[derive(Clone, Debug)]
pub struct Networks {
    /// Encoder, the same for both stages.
    pub encoder: Encoder,
    /// Stage-1 renderer: draws random subsets and uncondensed centroids.
    pub renderer: Renderer,
    /// Condenser and stage-2 renderer, once there are.
    pub condensed: Option<(Condenser, Renderer)>,
    /// Those trained on tiles of the views instead of K-means.
    pub patch_condensed: Option<(Condenser, Renderer)>,
    /// Where they live.
    pub device: Device,
}

/// Settings of a sweep.
#[derive(Clone, Debug)]
pub struct Sweep {
    /// Token counts a scene is stored with.
    pub storage: Vec<TokenCount>,
    /// Token counts a view is drawn from beside all that are stored, of these; those that are not fewer are left out.
    pub render: Vec<TokenCount>,
    /// How fewer tokens are chosen.
    pub selection: Selection,
    /// Number format that stored tokens are rounded to, as in a scene file; not those of [`Variant::Random`].
    pub tokens: TokenStorage,
    /// Which variants are rendered: those of [`Networks::variants`], or fewer.
    pub variants: Vec<Variant>,
    /// Latent K-means.
    pub kmeans: KMeans,
    /// Pixels along a side of the patch a token stands on.
    pub patch_size: usize,
    /// Seed of K-means and of what is random; each scene derives its own from it and its key.
    pub seed: u64,
}

impl Networks {
    /// Takes the networks of a stage 2 that was trained on such groups.
    pub fn set_condensed(&mut self, grouping: Grouping, condenser: Condenser, renderer: Renderer) {
        match grouping {
            Grouping::Kmeans => self.condensed = Some((condenser, renderer)),
            Grouping::Patch => self.patch_condensed = Some((condenser, renderer)),
        }
    }

    /// Whether there are weights for a variant.
    pub fn can_draw(&self, variant: Variant) -> bool {
        match variant {
            Variant::Random | Variant::Patch | Variant::Kmeans => true,
            Variant::Clift => self.condensed.is_some(),
            Variant::PatchClift => self.patch_condensed.is_some(),
            Variant::NearestView | Variant::MeanImage => false,
        }
    }

    /// What is drawn where nothing else is asked for, tiles only beside their condenser.
    pub fn variants(&self) -> Vec<Variant> {
        let all = [Variant::Random, Variant::Patch, Variant::PatchClift, Variant::Kmeans, Variant::Clift];
        let is_wanted = |variant: &Variant| *variant != Variant::Patch || self.patch_condensed.is_some();
        all.into_iter().filter(|variant| self.can_draw(*variant)).filter(is_wanted).collect()
    }
}

impl Sweep {
    /// Counts that views are drawn from where a scene has `num_storage_tokens`: fewer than those, rising.
    fn render_counts(&self, num_storage_tokens: usize) -> Vec<usize> {
        let counts = self.render.iter().filter_map(|count| count.of(num_storage_tokens).ok());
        let mut counts: Vec<usize> = counts.filter(|&count| count < num_storage_tokens).collect();
        counts.sort_unstable();
        counts.dedup();
        counts
    }
}

/// Renders and measures the targets of one scene; returns its pictures when they are to be shown.
///
/// Sampling per scene as in the paper: one random subset shared by all its targets.
///
/// # Errors
/// [`EvalError::BadTokenCount`] for a count the scene does not have, [`EvalError::NotFinite`] for a
/// rendering that is not finite, and whatever the model refuses.
pub fn evaluate_scene(
    networks: &Networks,
    clip: &Clip,
    sweep: &Sweep,
    is_shown: bool,
    into: &mut Accumulator,
) -> Result<Option<Shown>, EvalError> {
    let lift = networks.encoder.forward(&upload_views(&[&clip.context], &networks.device)?); // [1, N, D]
    let [_, num_tokens, dim] = lift.dims();
    let seed = derive_seed(sweep.seed, &clip.key);
    let grid = [clip.context.height, clip.context.width].map(|side| side / sweep.patch_size);
    let views = (clip.context.num_views(), grid);
    let variance = total_variance(&lift)?[0];
    let rows = if is_shown { sheet_rows(clip.target.num_views()) } else { Vec::new() };
    let is_shown = !rows.is_empty();
    let mut material = Material { renderings: baselines(clip, &rows)?, ..Material::default() };
    for &count in &sweep.storage {
        let num_storage_tokens = count.of(num_tokens)?;
        let bytes = file_bytes(num_storage_tokens, dim, clip.context.num_views(), sweep.tokens);
        let index = GroupsOnce::new(&sweep.kmeans, &lift, views, num_storage_tokens, seed);
        for &variant in &sweep.variants {
            let stored = Stored::new(variant, networks, &lift, &index, sweep.tokens)?;
            let setting = |num_render_tokens| Setting { variant, num_storage_tokens, num_render_tokens };
            let whole = setting(num_storage_tokens);
            let mut settings = vec![whole];
            material.renderings.push(render(&stored, &clip.target, whole, &rows)?);
            for num_render_tokens in sweep.render_counts(num_storage_tokens) {
                let some = setting(num_render_tokens);
                let chosen = sweep.selection.choose(clip, &stored.ids, sweep.patch_size, num_render_tokens, seed)?;
                material.renderings.push(render_chosen(&stored, &chosen, &clip.target, some, &rows)?);
                if is_shown {
                    material.choices.push((some, stored.ids.clone(), chosen));
                }
                settings.push(some);
            }
            if variant != Variant::Random {
                for setting in settings {
                    into.add_scene_bytes(setting, bytes);
                }
            }
        }
        if let Some(error) = index.cluster_error(variance) {
            into.add_cluster_error(&clip.key, num_storage_tokens, error);
        }
        if is_shown {
            material.clusters.push(index.scene_clusters()?.clone());
        }
    }
    for rendering in &material.renderings {
        for (&frame, &measured) in clip.target.frame_index.iter().zip(&rendering.measured) {
            // A target drawn twice is one view.
            if !into.contains(&clip.key, frame, rendering.setting) {
                into.add(&clip.key, frame, rendering.setting, measured)?;
            }
        }
    }
    if is_shown { Shown::new(clip, &material, &rows, sweep.patch_size).map(Some) } else { Ok(None) }
}

/// Draws every target from all tokens.
fn render(stored: &Stored, target: &HostViews, setting: Setting, rows: &[usize]) -> Result<Rendered, EvalError> {
    let Stored { tokens, renderer, .. } = stored;
    let mut rendered = Rendered::new(setting);
    let frame_len = target.height * target.width * 3;
    let device = tokens.device();
    let cameras = upload_cameras(&[target], &device)?;
    // So that the clock below does not count what is still queued.
    device.sync().map_err(EvalError::tensor)?;
    let started = Instant::now();
    let memory = renderer.memory(tokens);
    device.sync().map_err(EvalError::tensor)?;
    // Once for the scene: every view bears its share.
    let shared_s = started.elapsed().as_secs_f64() / target.num_views() as f64;
    for start in (0..target.num_views()).step_by(VIEWS_PER_PASS) {
        let count = VIEWS_PER_PASS.min(target.num_views() - start);
        let cameras = narrowed(&cameras, start, count);
        let started = Instant::now();
        let images = renderer.draw(&memory, &cameras); // [1, T, H, W, 3]
        let values: Vec<f32> = images.into_data().convert::<f32>().try_to_vec().map_err(EvalError::tensor)?;
        let render_s = shared_s + started.elapsed().as_secs_f64() / count as f64;
        for pixels in values.chunks(frame_len) {
            rendered.add(pixels.to_vec(), target, rows)?;
        }
        for measured in &mut rendered.measured[start..] {
            measured.render_s = Some(render_s);
        }
    }
    Ok(rendered)
}

/// Draws every target alone, from the tokens chosen for it.
fn render_chosen(
    stored: &Stored,
    chosen: &[Chosen],
    target: &HostViews,
    setting: Setting,
    rows: &[usize],
) -> Result<Rendered, EvalError> {
    let mut rendered = Rendered::new(setting);
    let device = stored.tokens.device();
    let cameras = upload_cameras(&[target], &device)?;
    device.sync().map_err(EvalError::tensor)?;
    for (view, Chosen { tokens, select_s }) in chosen.iter().enumerate() {
        let started = Instant::now();
        let tokens: Tensor<3> = rows_of(&stored.tokens, tokens); // [1, S, D] -> [1, R, D]
        let image = stored.renderer.forward(tokens, &narrowed(&cameras, view, 1));
        let pixels: Vec<f32> = image.into_data().convert::<f32>().try_to_vec().map_err(EvalError::tensor)?;
        let render_s = started.elapsed().as_secs_f64();
        rendered.add(pixels, target, rows)?;
        let measured = &mut rendered.measured[view];
        (measured.render_s, measured.select_s) = (Some(render_s), Some(*select_s));
    }
    Ok(rendered)
}

/// `count` views of a scene from the view `start` on.
fn narrowed(cameras: &Cameras, start: usize, count: usize) -> Cameras {
    Cameras {
        c2w: cameras.c2w.clone().narrow(1, start, count),
        intrinsics: cameras.intrinsics.clone().narrow(1, start, count),
        ..*cameras
    }
}

#[cfg(test)]
mod tests {
    use clift_model::Preset;

    use super::*;

    #[test]
    fn views_are_drawn_from_fewer_tokens_than_are_stored_each_count_once() {
        let sweep = Sweep {
            storage: Vec::new(),
            render: vec![
                TokenCount::Count(16),
                TokenCount::Share(0.5),
                TokenCount::Count(64),
                TokenCount::Share(1.0),
                TokenCount::Count(4),
            ],
            selection: Selection::Preset(Preset::Paper),
            tokens: TokenStorage::F32,
            variants: Vec::new(),
            kmeans: KMeans::default(),
            patch_size: 8,
            seed: 0,
        };
        assert_eq!(sweep.render_counts(128), [4, 16, 64]);
        assert_eq!(sweep.render_counts(32), [4, 16]);
        assert_eq!(sweep.render_counts(2), [1]);
        assert_eq!(sweep.render_counts(1), [0; 0]);
    }
}
