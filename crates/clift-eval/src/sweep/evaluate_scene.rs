//! The sweep of one scene: encoded once, rendered by every method at every token count.

use std::collections::btree_map::Entry;
use std::time::Instant;

use burn::tensor::Tensor;
use clift_data::{Clip, derive_seed};
use clift_model::{Cameras, FlopConvention, SceneModel, scene_file_bytes};

use crate::config::method::Method;
use crate::error::EvalError;
use crate::statistics::eval_results::EvalResults;
use crate::statistics::view_metrics::{Cost, EvalKey};
use crate::sweep::compressed_tokens::{CompressedTokens, select_tokens};
use crate::sweep::eval_models::EvalModels;
use crate::sweep::lazy_clusters::LazyClusters;
use crate::sweep::rendered_views::{MAX_KEPT_VIEWS, SceneResults, ScoredViews, baselines, spread};
use crate::sweep::sweep::{Sweep, render_counts};
use crate::sweep::token_choice::{SelectedTokens, select_for_views};
use crate::sweep::view_scorer::ViewScorer;
use crate::system::memory;
use crate::upload::{upload_cameras, upload_views};

/// Renders and scores the target views of one scene, and adds their metrics to `metrics`.
///
/// As in the paper, all target views of a scene share one random subset. Returns the images, clusters and selected
/// tokens of the scene if `keep_images` is set and the scene has a target view.
///
/// # Errors
/// [`BadTokenCount`](clift_model::ModelError::BadTokenCount) for a count above the tokens of the scene,
/// [`EvalError::BadImage`] for a rendering with a NaN or an infinity, and the errors of the model.
pub fn evaluate_scene(
    models: &EvalModels,
    clip: &Clip,
    sweep: &Sweep,
    keep_images: bool,
    metrics: &mut EvalResults,
) -> Result<Option<SceneResults>, EvalError> {
    let (stage1, device) = (&models.stage1.network, &models.stage1.device);
    let features = stage1.features(&upload_views(&[&clip.context], device)?);
    // A stage 2 with its own token norm clusters and condenses the tokens of its own norm.
    let normed: Vec<(Method, Tensor<3>)> = [Method::Clift, Method::PatchClift]
        .into_iter()
        .filter_map(|method| Some((method, &models.for_method(method)?.network)))
        .filter(|(_, network)| network.has_token_norm())
        .map(|(method, network)| (method, network.normalize(features.clone())))
        .collect();
    let lift = stage1.normalize(features); // [1, N, D]
    let [_, num_tokens, dim] = lift.dims();
    let seed = derive_seed(sweep.seed, &clip.key);
    let grid = [clip.context.height, clip.context.width].map(|side| side / sweep.model.patch_size);
    let views = (clip.context.num_views(), grid);
    let kept_views = if keep_images { spread(clip.target.num_views(), MAX_KEPT_VIEWS) } else { Vec::new() };
    let keep_images = !kept_views.is_empty();
    let scorer = ViewScorer::new(&clip.target, sweep.lpips.as_ref());
    let renderer = TargetRenderer { clip, scorer: &scorer, cameras: upload_cameras(&[&clip.target], device)?, sweep };
    let mut results = SceneResults::new(baselines(clip, &scorer, &kept_views)?, kept_views.clone());
    for rendering in &results.renderings {
        record(clip, rendering, metrics)?;
    }
    for &count in &sweep.storage {
        let num_storage_tokens = count.of(num_tokens)?;
        let index = LazyClusters::new(&sweep.kmeans, &lift, views, num_storage_tokens, seed);
        let own_norm: Vec<_> = normed
            .iter()
            .map(|(of, lift)| (*of, lift, LazyClusters::new(&sweep.kmeans, lift, views, num_storage_tokens, seed)))
            .collect();
        for &method in &sweep.methods {
            let own = own_norm.iter().find(|(of, ..)| *of == method);
            let (lift, index) = own.map_or((&lift, &index), |(_, lift, index)| (*lift, index));
            for (i, &tokens) in sweep.formats(method).iter().enumerate() {
                let kept_views = if i == 0 { &kept_views[..] } else { &[] };
                let stored = CompressedTokens::new(method, models, lift, index, tokens)?;
                let whole =
                    EvalKey { method, num_storage_tokens, num_render_tokens: num_storage_tokens, tokens: Some(tokens) };
                let mut renderings = vec![renderer.render(&stored, None, whole, kept_views, metrics)?];
                let can_select = stored.model.network.supports_selection();
                for num_render_tokens in
                    render_counts(&sweep.render, num_storage_tokens).into_iter().filter(|_| can_select)
                {
                    let some = EvalKey { num_render_tokens, ..whole };
                    let patch_size = sweep.model.patch_size;
                    metrics.selection = Some(sweep.selection);
                    let selected =
                        select_for_views(sweep.selection, clip, &stored.ids, patch_size, num_render_tokens, seed)?;
                    renderings.push(renderer.render(&stored, Some(&selected), some, kept_views, metrics)?);
                    if !kept_views.is_empty() {
                        results.selections.push((some, stored.ids.clone(), selected));
                    }
                }
                let bytes = scene_file_bytes(num_storage_tokens, dim, clip.context.num_views(), tokens);
                for rendering in renderings {
                    record(clip, &rendering, metrics)?;
                    if method != Method::Random {
                        metrics.add_scene_bytes(rendering.key, bytes);
                    }
                    if !kept_views.is_empty() {
                        results.renderings.push(rendering);
                    }
                }
            }
        }
        if keep_images {
            let own = own_norm.iter().find(|(of, ..)| *of == Method::Clift);
            let index = own.map_or(&index, |(.., index)| index);
            results.clusters.push(index.clusters()?.scenes()[0].clone());
        }
    }
    for external in &sweep.external_methods {
        let scored = external.score(clip, &scorer, &kept_views, metrics)?;
        record(clip, &scored, metrics)?;
        results.renderings.push(scored);
    }
    Ok(keep_images.then_some(results))
}

/// Adds the metrics of a scene under one key. A frame that is a target twice counts once.
fn record(clip: &Clip, rendering: &ScoredViews, metrics: &mut EvalResults) -> Result<(), EvalError> {
    for (&view, &measured) in &rendering.metrics {
        let frame = clip.target.frame_index[view];
        if !metrics.contains(&clip.key, frame, rendering.key) {
            metrics.add(&clip.key, frame, rendering.key, measured)?;
        }
    }
    Ok(())
}

/// Renders and times the target views of a scene, key by key.
struct TargetRenderer<'a> {
    clip: &'a Clip,
    scorer: &'a ViewScorer<'a>,
    cameras: Cameras,
    sweep: &'a Sweep,
}

impl TargetRenderer<'_> {
    /// Renders every target view in a call of its own, from all stored tokens or from the tokens selected for the view.
    /// The measured time is from tokens on the device to pixels on the host. Views share no work, so the times of any two
    /// keys are comparable. A viewer that keeps the keys and values of a scene's tokens between frames is faster.
    fn render(
        &self,
        stored: &CompressedTokens,
        selected: Option<&[SelectedTokens]>,
        key: EvalKey,
        kept_views: &[usize],
        metrics: &mut EvalResults,
    ) -> Result<ScoredViews, EvalError> {
        let target = &self.clip.target;
        let device = stored.tokens.device();
        let render = |view: usize| -> Result<Vec<f32>, EvalError> {
            let tokens: Tensor<3> = match selected {
                Some(selected) => select_tokens(&stored.tokens, &selected[view].tokens), // [1, S, D] -> [1, R, D]
                None => stored.tokens.clone(),
            };
            let image = stored.model.network.render(tokens, &camera_of(&self.cameras, view)); // [1, 1, H, W, 3]
            image.into_data().convert::<f32>().try_to_vec().map_err(EvalError::tensor)
        };
        // Queued work must not count as rendering time.
        device.sync().map_err(EvalError::tensor)?;
        if let Entry::Vacant(cost) = metrics.costs.entry(key) {
            // One untimed view per key: one-time work of the device, and the peak memory.
            let has_peak = self.sweep.is_cpu && memory::start_peak().is_some();
            render(0)?;
            let peak_bytes = if has_peak { memory::peak_bytes() } else { None };
            let macs = self.sweep.model.render_macs(target.height, target.width, key.num_render_tokens)?;
            let gflops = Some(macs.count(FlopConvention::Macs) as f64 / 1e9);
            cost.insert(Cost { gflops, peak_bytes, scene_bytes: None });
        }
        let mut rendered = ScoredViews::new(key);
        for view in 0..target.num_views() {
            let started = Instant::now();
            let pixels = render(view)?;
            let render_s = started.elapsed().as_secs_f64();
            let measured = rendered.add(view, pixels, self.scorer, kept_views)?;
            measured.render_s = Some(render_s);
            measured.select_s = selected.map(|selected| selected[view].select_s);
        }
        Ok(rendered)
    }
}

fn camera_of(cameras: &Cameras, view: usize) -> Cameras {
    Cameras {
        c2w: cameras.c2w.clone().narrow(1, view, 1),
        intrinsics: cameras.intrinsics.clone().narrow(1, view, 1),
        ..*cameras
    }
}
