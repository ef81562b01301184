//! The sweep: every scene encoded once, rendered with every variant at every token count.

use std::time::Instant;

use burn::tensor::Tensor;
use clift_data::{Clip, derive_seed};
use clift_model::{Cameras, FlopConvention, SceneModel, scene_file_bytes};

use crate::config::method::Method;
use crate::error::EvalError;
use crate::statistics::eval_results::EvalResults;
use crate::statistics::view_metrics::EvalKey;
use crate::sweep::compressed_tokens::{CompressedTokens, select_tokens};
use crate::sweep::eval_models::EvalModels;
use crate::sweep::lazy_clusters::LazyClusters;
use crate::sweep::rendered_views::{ScoredViews, baselines};
use crate::sweep::scene_results::{SceneResults, sheet_rows};
use crate::sweep::sweep::Sweep;
use crate::sweep::token_choice::{SelectedTokens, choose};
use crate::sweep::view_scorer::ViewScorer;
use crate::system::memory;
use crate::upload::{upload_cameras, upload_views};

/// Renders and measures the targets of one scene; returns its images where they are to be shown.
///
/// Sampling per scene as in the paper: one random subset shared by all its targets.
///
/// # Errors
/// [`BadTokenCount`](clift_model::ModelError::BadTokenCount) for a count the scene does not have, [`EvalError::NotFinite`] for a
/// rendering that is not finite, and whatever the model refuses.
pub fn evaluate_scene(
    models: &EvalModels,
    clip: &Clip,
    sweep: &Sweep,
    is_shown: bool,
    into: &mut EvalResults,
) -> Result<Option<SceneResults>, EvalError> {
    let (stage1, device) = (&models.stage1.network, &models.stage1.device);
    let features = stage1.features(&upload_views(&[&clip.context], device)?);
    // Where stage 2 has trained a norm of the tokens, condensed ones are of that norm, and of its clusters.
    let normed: Vec<(Method, Tensor<3>)> = [Method::Clift, Method::PatchClift]
        .into_iter()
        .filter_map(|variant| Some((variant, &models.for_method(variant)?.network)))
        .filter(|(_, network)| network.has_token_norm())
        .map(|(variant, network)| (variant, network.normalize(features.clone())))
        .collect();
    let lift = stage1.normalize(features); // [1, N, D]
    let [_, num_tokens, dim] = lift.dims();
    let seed = derive_seed(sweep.seed, &clip.key);
    let grid = [clip.context.height, clip.context.width].map(|side| side / sweep.model.patch_size);
    let views = (clip.context.num_views(), grid);
    let rows = if is_shown { sheet_rows(clip.target.num_views()) } else { Vec::new() };
    let is_shown = !rows.is_empty();
    let scorer = ViewScorer::new(&clip.target, sweep.lpips.as_ref());
    let drawing = Drawing { clip, scorer: &scorer, cameras: upload_cameras(&[&clip.target], device)?, sweep };
    let mut material = SceneResults::new(baselines(clip, &scorer, &rows)?, rows.clone());
    for rendering in &material.renderings {
        record(clip, rendering, into)?;
    }
    for &count in &sweep.storage {
        let num_storage_tokens = count.of(num_tokens)?;
        let index = LazyClusters::new(&sweep.kmeans, &lift, views, num_storage_tokens, seed);
        let own: Vec<_> = normed
            .iter()
            .map(|(of, lift)| (*of, lift, LazyClusters::new(&sweep.kmeans, lift, views, num_storage_tokens, seed)))
            .collect();
        for &variant in &sweep.variants {
            let own = own.iter().find(|(of, ..)| *of == variant);
            let (lift, index) = own.map_or((&lift, &index), |(_, lift, index)| (*lift, index));
            for (i, &tokens) in sweep.formats(variant).iter().enumerate() {
                let rows = if i == 0 { &rows[..] } else { &[] };
                let stored = CompressedTokens::new(variant, models, lift, index, tokens)?;
                let whole = EvalKey {
                    variant,
                    num_storage_tokens,
                    num_render_tokens: num_storage_tokens,
                    tokens: Some(tokens),
                };
                let mut renderings = vec![drawing.render(&stored, None, whole, rows, into)?];
                let can_select = stored.model.network.supports_selection();
                for num_render_tokens in sweep.render_counts(num_storage_tokens).into_iter().filter(|_| can_select) {
                    let some = EvalKey { num_render_tokens, ..whole };
                    let patch_size = sweep.model.patch_size;
                    into.selection = Some(sweep.selection);
                    let chosen = choose(sweep.selection, clip, &stored.ids, patch_size, num_render_tokens, seed)?;
                    renderings.push(drawing.render(&stored, Some(&chosen), some, rows, into)?);
                    if !rows.is_empty() {
                        material.choices.push((some, stored.ids.clone(), chosen));
                    }
                }
                let bytes = scene_file_bytes(num_storage_tokens, dim, clip.context.num_views(), tokens);
                for rendering in renderings {
                    record(clip, &rendering, into)?;
                    if variant != Method::Random {
                        into.add_scene_bytes(rendering.setting, bytes);
                    }
                    if !rows.is_empty() {
                        material.renderings.push(rendering);
                    }
                }
            }
        }
        if is_shown {
            let own = own.iter().find(|(of, ..)| *of == Method::Clift);
            let index = own.map_or(&index, |(.., index)| index);
            material.clusters.push(index.scene_clusters()?.clone());
        }
    }
    for system in &sweep.systems {
        let scored = system.score(clip, &scorer, &rows, into)?;
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
fn record(clip: &Clip, rendering: &ScoredViews, into: &mut EvalResults) -> Result<(), EvalError> {
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
    scorer: &'a ViewScorer<'a>,
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
        stored: &CompressedTokens,
        chosen: Option<&[SelectedTokens]>,
        setting: EvalKey,
        rows: &[usize],
        into: &mut EvalResults,
    ) -> Result<ScoredViews, EvalError> {
        let target = &self.clip.target;
        let device = stored.tokens.device();
        let draw = |view: usize| -> Result<Vec<f32>, EvalError> {
            let tokens: Tensor<3> = match chosen {
                Some(chosen) => select_tokens(&stored.tokens, &chosen[view].tokens), // [1, S, D] -> [1, R, D]
                None => stored.tokens.clone(),
            };
            let image = stored.model.network.render(tokens, &narrowed(&self.cameras, view, 1)); // [1, 1, H, W, 3]
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
            into.add_gflops(setting, macs.count(FlopConvention::Macs) as f64 / 1e9);
        }
        let mut rendered = ScoredViews::new(setting);
        for view in 0..target.num_views() {
            let started = Instant::now();
            let pixels = draw(view)?;
            let render_s = started.elapsed().as_secs_f64();
            rendered.add(pixels, self.scorer, rows)?;
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
