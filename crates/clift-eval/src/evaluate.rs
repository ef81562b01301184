//! The sweep: every scene encoded once, rendered with every variant at every token count.

use std::time::Instant;

use burn::tensor::{Device, Tensor};
use clift_data::Clip;
use clift_data::order::derive_seed;
use clift_model::scene::file_bytes;
use clift_model::{
    Cameras, Clift, Condenser, Convention, Encoder, Grouping, KMeans, LiftNorm, ModelConfig, Renderer, TokenStorage,
};

use crate::error::EvalError;
use crate::eval_results::EvalResults;
use crate::lpips::Lpips;
use crate::memory;
use crate::method::Variant;
use crate::predictions::System;
use crate::rendered::{Judge, Rendered, baselines};
use crate::scene_results::{SceneResults, sheet_rows};
use crate::selection::Selection;
use crate::stored::{GroupsOnce, Stored, rows_of};
use crate::token_choice::{SelectedTokens, choose};
use crate::token_count::TokenCount;
use crate::upload::{upload_cameras, upload_views};
use crate::view_metrics::EvalKey;

/// The networks of an evaluation, on a device without autodiff.
#[derive(Clone, Debug)]
pub struct Networks {
    /// Encoder, the same for both stages.
    pub encoder: Encoder,
    /// A norm of its tokens, in the variant that has one: that of stage 1.
    pub lift_norm: LiftNorm,
    /// Stage-1 renderer: draws random subsets and uncondensed centroids.
    pub renderer: Renderer,
    /// What stage 2 trained, once it has.
    pub condensed: Option<Condensed>,
    /// The same, trained on tiles of the views instead of K-means.
    pub patch_condensed: Option<Condensed>,
    /// Where they live.
    pub device: Device,
}

/// The networks that stage 2 trains.
#[derive(Clone, Debug)]
pub struct Condensed {
    /// A norm of the encoder's tokens, in the variant that has one.
    pub lift_norm: LiftNorm,
    /// Writes the tokens of a cluster into its centroid.
    pub condenser: Condenser,
    /// Draws condensed tokens.
    pub renderer: Renderer,
}

impl Condensed {
    /// Those of a model.
    pub fn of(model: &Clift) -> Self {
        let Clift { lift_norm, condenser, renderer, .. } = model.clone();
        Self { lift_norm, condenser, renderer }
    }
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
    /// Number formats that stored tokens are rounded to, as in a scene file, one after the other. Random subsets have
    /// no file and are not rounded. Pictures are shown of the first.
    pub tokens: Vec<TokenStorage>,
    /// Which variants are rendered: those of [`Networks::variants`], or fewer.
    pub variants: Vec<Variant>,
    /// Latent K-means.
    pub kmeans: KMeans,
    /// Sizes of the networks.
    pub model: ModelConfig,
    /// LPIPS, where its weights are there.
    pub lpips: Option<Lpips>,
    /// Other systems' pictures.
    pub systems: Vec<System>,
    /// Whether tensors live in this process's memory, so that its peak says something.
    pub is_cpu: bool,
    /// Seed of K-means and of what is random; each scene derives its own from it and its key.
    pub seed: u64,
}

impl Networks {
    /// Takes the networks of a stage 2 that was trained on such groups.
    pub fn set_condensed(&mut self, grouping: Grouping, condensed: Condensed) {
        match grouping {
            Grouping::Kmeans => self.condensed = Some(condensed),
            Grouping::Tile => self.patch_condensed = Some(condensed),
        }
    }

    /// What stage 2 trained for a variant.
    pub(crate) fn condensed_of(&self, variant: Variant) -> Option<&Condensed> {
        match variant {
            Variant::Clift => self.condensed.as_ref(),
            Variant::PatchClift => self.patch_condensed.as_ref(),
            _ => None,
        }
    }

    /// Whether there are weights for a variant.
    pub fn can_draw(&self, variant: Variant) -> bool {
        match variant {
            Variant::Random | Variant::Patch | Variant::Kmeans => true,
            Variant::Clift => self.condensed.is_some(),
            Variant::PatchClift => self.patch_condensed.is_some(),
            Variant::NearestView | Variant::MeanImage | Variant::System(_) => false,
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
    /// Tokens that a target is drawn from, for every time it is drawn where a scene has `num_storage_tokens`.
    pub fn drawn(&self, num_storage_tokens: usize) -> Vec<usize> {
        let counts = [vec![num_storage_tokens], self.render_counts(num_storage_tokens)].concat();
        let num_formats: usize = self.variants.iter().map(|&variant| self.formats(variant).len()).sum();
        counts.repeat(num_formats)
    }

    /// Counts that views are drawn from where a scene has `num_storage_tokens`: fewer than those, rising.
    fn render_counts(&self, num_storage_tokens: usize) -> Vec<usize> {
        let counts = self.render.iter().filter_map(|count| count.of(num_storage_tokens).ok());
        let mut counts: Vec<usize> = counts.filter(|&count| count < num_storage_tokens).collect();
        counts.sort_unstable();
        counts.dedup();
        counts
    }

    fn formats(&self, variant: Variant) -> &[TokenStorage] {
        if variant == Variant::Random { &[TokenStorage::F32] } else { &self.tokens }
    }
}

/// Renders and measures the targets of one scene; returns its images where they are to be shown.
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
    into: &mut EvalResults,
) -> Result<Option<SceneResults>, EvalError> {
    let features = networks.encoder.forward(&upload_views(&[&clip.context], &networks.device)?);
    // Where stage 2 has trained a norm of the tokens, condensed ones are of that norm, and of its clusters.
    let normed: Vec<(Variant, Tensor<3>)> = [Variant::Clift, Variant::PatchClift]
        .into_iter()
        .filter_map(|variant| Some((variant, networks.condensed_of(variant)?)))
        .filter(|(_, condensed)| condensed.lift_norm.is_norm())
        .map(|(variant, condensed)| (variant, condensed.lift_norm.forward(features.clone())))
        .collect();
    let lift = networks.lift_norm.forward(features); // [1, N, D]
    let [_, num_tokens, dim] = lift.dims();
    let seed = derive_seed(sweep.seed, &clip.key);
    let grid = [clip.context.height, clip.context.width].map(|side| side / sweep.model.patch_size);
    let views = (clip.context.num_views(), grid);
    let rows = if is_shown { sheet_rows(clip.target.num_views()) } else { Vec::new() };
    let is_shown = !rows.is_empty();
    let judge = Judge::new(&clip.target, sweep.lpips.as_ref());
    let drawing = Drawing { clip, judge: &judge, cameras: upload_cameras(&[&clip.target], &networks.device)?, sweep };
    let mut material = SceneResults::new(baselines(clip, &judge, &rows)?, rows.clone());
    for rendering in &material.renderings {
        record(clip, rendering, into)?;
    }
    for &count in &sweep.storage {
        let num_storage_tokens = count.of(num_tokens)?;
        let index = GroupsOnce::new(&sweep.kmeans, &lift, views, num_storage_tokens, seed);
        let own: Vec<_> = normed
            .iter()
            .map(|(of, lift)| (*of, lift, GroupsOnce::new(&sweep.kmeans, lift, views, num_storage_tokens, seed)))
            .collect();
        for &variant in &sweep.variants {
            let own = own.iter().find(|(of, ..)| *of == variant);
            let (lift, index) = own.map_or((&lift, &index), |(_, lift, index)| (*lift, index));
            for (i, &tokens) in sweep.formats(variant).iter().enumerate() {
                let rows = if i == 0 { &rows[..] } else { &[] };
                let stored = Stored::new(variant, networks, lift, index, tokens)?;
                let whole = EvalKey {
                    variant,
                    num_storage_tokens,
                    num_render_tokens: num_storage_tokens,
                    tokens: Some(tokens),
                };
                let mut renderings = vec![drawing.render(&stored, None, whole, rows, into)?];
                for num_render_tokens in sweep.render_counts(num_storage_tokens) {
                    let some = EvalKey { num_render_tokens, ..whole };
                    let patch_size = sweep.model.patch_size;
                    into.selection = Some(sweep.selection);
                    let chosen = choose(sweep.selection, clip, &stored.ids, patch_size, num_render_tokens, seed)?;
                    renderings.push(drawing.render(&stored, Some(&chosen), some, rows, into)?);
                    if !rows.is_empty() {
                        material.choices.push((some, stored.ids.clone(), chosen));
                    }
                }
                let bytes = file_bytes(num_storage_tokens, dim, clip.context.num_views(), tokens);
                for rendering in renderings {
                    record(clip, &rendering, into)?;
                    if variant != Variant::Random {
                        into.add_scene_bytes(rendering.setting, bytes);
                    }
                    if !rows.is_empty() {
                        material.renderings.push(rendering);
                    }
                }
            }
        }
        if is_shown {
            let own = own.iter().find(|(of, ..)| *of == Variant::Clift);
            let index = own.map_or(&index, |(.., index)| index);
            material.clusters.push(index.scene_clusters()?.clone());
        }
    }
    for system in &sweep.systems {
        let scored = system.score(clip, &judge, &rows, into)?;
        for (&view, &measured) in &scored.measured {
            let frame = clip.target.frame_index[view];
            if !into.contains(&clip.key, frame, scored.setting) {
                into.add(&clip.key, frame, scored.setting, measured)?;
            }
        }
        material.others.push(scored);
    }
    Ok(is_shown.then_some(material))
}

/// Adds what was measured of a scene in one setting.
fn record(clip: &Clip, rendering: &Rendered, into: &mut EvalResults) -> Result<(), EvalError> {
    for (&frame, &measured) in clip.target.frame_index.iter().zip(&rendering.measured) {
        // A target drawn twice is one view.
        if !into.contains(&clip.key, frame, rendering.setting) {
            into.add(&clip.key, frame, rendering.setting, measured)?;
        }
    }
    Ok(())
}

/// The targets of a scene, to be drawn in many settings.
struct Drawing<'a> {
    clip: &'a Clip,
    judge: &'a Judge<'a>,
    cameras: Cameras,
    sweep: &'a Sweep,
}

impl Drawing<'_> {
    /// Draws every target alone, from all stored tokens or from those chosen for it.
    ///
    /// The clock runs from tokens on the device to pixels on the host. Nothing is shared between views, so that times of
    /// any two settings can be compared; a viewer that draws a scene from all its tokens again and again keeps their keys
    /// and values and is faster.
    fn render(
        &self,
        stored: &Stored,
        chosen: Option<&[SelectedTokens]>,
        setting: EvalKey,
        rows: &[usize],
        into: &mut EvalResults,
    ) -> Result<Rendered, EvalError> {
        let target = &self.clip.target;
        let device = stored.tokens.device();
        let draw = |view: usize| -> Result<Vec<f32>, EvalError> {
            let tokens: Tensor<3> = match chosen {
                Some(chosen) => rows_of(&stored.tokens, &chosen[view].tokens), // [1, S, D] -> [1, R, D]
                None => stored.tokens.clone(),
            };
            let image = stored.renderer.forward(tokens, &narrowed(&self.cameras, view, 1)); // [1, 1, H, W, 3]
            image.into_data().convert::<f32>().try_to_vec().map_err(EvalError::tensor)
        };
        // So that the clock does not count what is still queued.
        device.sync().map_err(EvalError::tensor)?;
        if !into.is_warm(setting) {
            // Once before all views of the setting that are timed: for what a device does only once, and for the memory.
            let has_peak = self.sweep.is_cpu && memory::start_peak().is_some();
            draw(0)?;
            into.set_warm(setting, if has_peak { memory::peak_bytes() } else { None });
            let macs = self.sweep.model.render_macs(target.height, target.width, setting.num_render_tokens)?;
            into.add_gflops(setting, macs.count(Convention::Macs) as f64 / 1e9);
        }
        let mut rendered = Rendered::new(setting);
        for view in 0..target.num_views() {
            let started = Instant::now();
            let pixels = draw(view)?;
            let render_s = started.elapsed().as_secs_f64();
            rendered.add(pixels, self.judge, rows)?;
            let measured = &mut rendered.measured[view];
            measured.render_s = Some(render_s);
            measured.select_s = chosen.map(|chosen| chosen[view].select_s);
        }
        Ok(rendered)
    }
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
            tokens: vec![TokenStorage::F32],
            variants: Vec::new(),
            kmeans: KMeans::default(),
            model: ModelConfig::default(),
            lpips: None,
            systems: Vec::new(),
            is_cpu: true,
            seed: 0,
        };
        assert_eq!(sweep.render_counts(128), [4, 16, 64]);
        assert_eq!(sweep.render_counts(32), [4, 16]);
        assert_eq!(sweep.render_counts(2), [1]);
        assert_eq!(sweep.render_counts(1), [0; 0]);
    }
}
