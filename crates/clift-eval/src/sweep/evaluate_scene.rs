//! The sweep of one scene: encoded once, rendered by every method at every token count.

use std::time::Instant;

use clift_data::Clip;
use clift_model::{Cameras, FlopConvention, ModelError, Tokens, TrainedModel, Views};
use clift_scene::{CodedLoss, TokenCoding};

use crate::config::method::Method;
use crate::error::EvalError;
use crate::statistics::eval_results::EvalResults;
use crate::statistics::view_metrics::{Cost, EvalKey};
use crate::sweep::compressed_tokens::{CompressedTokens, Lift};
use crate::sweep::context_check::check_contexts;
use crate::sweep::eval_models::EvalModels;
use crate::sweep::rendered_views::{MAX_KEPT_VIEWS, SceneResults, ScoredViews, baselines, spread};
use crate::sweep::sweep::Sweep;
use crate::sweep::token_choice::{SelectedTokens, select_for_views};
use crate::sweep::view_scorer::ViewScorer;
use crate::system::memory;

/// Renders and scores the target views of one scene, and adds their metrics to `metrics`.
///
/// As in the paper, all target views of a scene share one random subset. Returns the images of the scene if `keep_images` is
/// set and the scene has a target view.
pub(crate) fn evaluate_scene(
    models: &EvalModels,
    clip: &Clip,
    sweep: &Sweep,
    keep_images: bool,
    metrics: &mut EvalResults,
) -> Result<Option<SceneResults>, EvalError> {
    let device = &models.stage1.device;
    let context = &models.stage1.upload(&clip.context, &sweep.eval.stored_tokens)?;
    let kept_views = if keep_images { spread(clip.target.num_views(), MAX_KEPT_VIEWS) } else { Vec::new() };
    let scorer = &ViewScorer::new(clip, sweep.lpips.as_ref());
    let cameras = Cameras::upload(&[&clip.target], device)?;
    let mut renderings = baselines(clip, scorer, &kept_views)?;
    for rendering in &renderings {
        record(clip, rendering, metrics);
    }
    let given = clip.target.frame_index.iter().filter(|frame| clip.context.frame_index.contains(frame));
    metrics.context_targets.extend(given.map(|&frame| (clip.key.clone(), frame)));
    metrics.facts.context_frames.insert(clip.key.clone(), clip.context.frame_index.clone());
    if sweep.checks_contexts {
        metrics.add_context_check(check_contexts(models, context, clip)?);
    }
    for (view, &frame) in clip.target.frame_index.iter().enumerate() {
        if let Some((_, share)) = scorer.weights(view) {
            metrics.masked.entry(clip.key.clone()).or_default().insert(frame, 1.0 - share);
        }
    }
    let mut scene = SceneJobs { models, clip, sweep, context, cameras, scorer, metrics, jobs: Vec::new() };
    if models.stage1.config.architecture.supports_clusters() {
        scene.add_clustered(&kept_views)?;
    }
    scene.add_whole(&kept_views)?;
    for (job, rendering) in scene.jobs.iter().zip(scene.render()?) {
        record(clip, &rendering, scene.metrics);
        if !job.kept_views.is_empty() {
            renderings.push(rendering);
        }
    }
    Ok((!kept_views.is_empty()).then_some(SceneResults { renderings, kept_views }))
}

/// Adds the metrics of a scene under one key. A frame that is a target twice counts once.
fn record(clip: &Clip, rendering: &ScoredViews, metrics: &mut EvalResults) {
    for (&view, &measured) in &rendering.metrics {
        metrics.add(&clip.key, clip.target.frame_index[view], rendering.key, measured);
    }
}

struct RenderJob<'a> {
    key: EvalKey,
    /// Stored tokens, `[1, S, D]`.
    tokens: Tokens,
    model: &'a TrainedModel,
    /// The tokens selected for every target; `None` for all stored tokens.
    selected: Option<Vec<SelectedTokens>>,
    kept_views: &'a [usize],
}

/// The renderings to make of a scene, and what they are made and scored with.
struct SceneJobs<'a> {
    models: &'a EvalModels,
    clip: &'a Clip,
    sweep: &'a Sweep,
    context: &'a Views,
    /// Cameras of the target views.
    cameras: Cameras,
    scorer: &'a ViewScorer<'a>,
    metrics: &'a mut EvalResults,
    jobs: Vec<RenderJob<'a>>,
}

impl<'a> SceneJobs<'a> {
    /// Adds the renderings of `CLiFT`'s methods from every count of stored tokens.
    fn add_clustered(&mut self, kept_views: &'a [usize]) -> Result<(), EvalError> {
        let Self { models, clip, sweep, context, .. } = *self;
        let stage1 = &models.stage1.network;
        let features = stage1.features(context);
        // Stage 2 may have trained its own token norm; its tokens are then grouped and condensed after that norm.
        let own: Vec<(Method, Lift)> = Method::own()
            .filter(|method| method.is_condensed())
            .filter_map(|method| Some((method, models.for_method(method)?)))
            .filter(|(_, model)| model.config.has_token_norm())
            .map(|(method, model)| (method, Lift::new(model.network.normalize(features.clone()), sweep, clip)))
            .collect();
        let lift = Lift::new(stage1.normalize(features), sweep, clip);
        for &count in &sweep.eval.stored_tokens {
            let count = count.of(lift.tokens.dims()[1])?;
            for &method in sweep.eval.methods.iter().filter(|method| method.network().is_none()) {
                let lift = own.iter().find(|(of, _)| *of == method).map_or(&lift, |(_, lift)| lift);
                let compressed =
                    |coding, path: &str| CompressedTokens::new(method, models, (lift, count), coding, (clip, path));
                for (i, coding) in sweep.eval.formats_of(method).into_iter().enumerate() {
                    let stored = compressed(coding, sweep.model_path.as_str())?;
                    let kept_views = if i == 0 { kept_views } else { &[] };
                    let whole = key_of(method, count, coding);
                    self.add(whole, &stored, None, kept_views)?;
                    for num_render_tokens in sweep.eval.render_counts(count) {
                        let (selection, patch_size) = (sweep.eval.selection, sweep.model.patch_size);
                        self.metrics.facts.selection = Some(selection);
                        let selected =
                            select_for_views(selection, clip, &stored.ids, patch_size, num_render_tokens, lift.seed)?;
                        self.add(EvalKey { num_render_tokens, ..whole }, &stored, Some(selected), kept_views)?;
                    }
                    if method == Method::Clift && models.codec.is_some() {
                        // Without the path of the model: equal runs have equal results in any folder.
                        let coded = compressed(TokenCoding::Coded(CodedLoss::default()), "")?;
                        self.metrics.add_coded_bytes(whole, coded.file_bytes.unwrap_or_default());
                    }
                }
            }
        }
        Ok(())
    }

    /// Adds the renderings of every network without clusters, each from all its tokens.
    fn add_whole(&mut self, kept_views: &'a [usize]) -> Result<(), EvalError> {
        let Self { models, clip, sweep, context, .. } = *self;
        for model in &models.whole {
            let method = Method::Whole(model.config.architecture);
            if !sweep.eval.methods.contains(&method) {
                continue;
            }
            let tokens = model.network.encode(context);
            for (i, coding) in sweep.eval.formats_of(method).into_iter().enumerate() {
                let TokenCoding::Plain(format) = coding else { continue };
                let stored = CompressedTokens::whole(model, tokens.clone(), format, clip.context.num_views())?;
                let key = key_of(method, tokens.dims()[1], coding);
                self.add(key, &stored, None, if i == 0 { kept_views } else { &[] })?;
            }
        }
        Ok(())
    }

    /// Adds a job and the size of its scene file, and renders one untimed view of a key that has no cost yet: one-time work of
    /// the device, and the peak memory.
    fn add(
        &mut self,
        key: EvalKey,
        stored: &CompressedTokens<'a>,
        selected: Option<Vec<SelectedTokens>>,
        kept_views: &'a [usize],
    ) -> Result<(), EvalError> {
        let job = RenderJob { key, tokens: stored.tokens.clone(), model: stored.model, selected, kept_views };
        let has_cost = self.metrics.costs.contains_key(&key);
        if !has_cost {
            let has_peak = self.sweep.is_cpu && memory::start_peak().is_some();
            self.render_view(&job, 0)?;
            let peak_bytes = if has_peak { memory::peak_bytes() } else { None };
            let target = &self.clip.target;
            let macs = job.model.config.render_macs(target.height, target.width, key.num_render_tokens)?;
            let gflops = Some(macs.count(FlopConvention::Macs) as f64 / 1e9);
            let scene_values = Some((key.num_storage_tokens * job.model.config.dim) as u64);
            self.metrics.costs.insert(key, Cost { gflops, scene_values, peak_bytes, ..Cost::default() });
        }
        if let Some(bytes) = stored.file_bytes {
            self.metrics.add_scene_bytes(key, bytes);
        }
        self.jobs.push(job);
        Ok(())
    }

    /// Renders one target view in a call of its own.
    fn render_view(&self, job: &RenderJob, view: usize) -> Result<Vec<f32>, EvalError> {
        let tokens = match &job.selected {
            Some(selected) => job.tokens.select(&selected[view].tokens), // [1, S, D] -> [1, R, D]
            None => job.tokens.clone(),
        };
        let (c2w, intrinsics) = (self.cameras.c2w.clone(), self.cameras.intrinsics.clone());
        let camera = Cameras { c2w: c2w.narrow(1, view, 1), intrinsics: intrinsics.narrow(1, view, 1), ..self.cameras };
        let image = job.model.network.render(tokens, &camera); // [1, 1, H, W, 3]
        Ok(image.into_data().convert::<f32>().try_to_vec().map_err(ModelError::device)?)
    }

    /// Renders every target view with every job, and returns the scored views of each job.
    ///
    /// The measured time is from tokens on the device to pixels on the host. Views share no work, so the times of any two
    /// keys are comparable. A viewer that keeps the keys and values of a scene's tokens between frames is faster. The jobs
    /// take turns at every view, in alternating order, so that a change in the load of the machine meets all of them.
    fn render(&self) -> Result<Vec<ScoredViews>, EvalError> {
        let jobs = &self.jobs;
        let mut scored: Vec<ScoredViews> = jobs.iter().map(|job| ScoredViews::new(job.key)).collect();
        if let Some(job) = jobs.first() {
            // Queued work must not count as rendering.
            job.tokens.values.device().sync().map_err(ModelError::device)?;
        }
        for view in 0..self.clip.target.num_views() {
            for turn in 0..jobs.len() {
                let i = if view % 2 == 1 { jobs.len() - 1 - turn } else { turn };
                let started = Instant::now();
                let pixels = self.render_view(&jobs[i], view)?;
                let render_s = started.elapsed().as_secs_f64();
                let measured = scored[i].add(view, pixels, self.scorer, jobs[i].kept_views)?;
                measured.render_s = Some(render_s);
                measured.select_s = jobs[i].selected.as_ref().map(|selected| selected[view].select_s);
            }
        }
        Ok(scored)
    }
}

/// Returns the key of a rendering from all stored tokens.
fn key_of(method: Method, count: usize, coding: TokenCoding) -> EvalKey {
    EvalKey { method, num_storage_tokens: count, num_render_tokens: count, tokens: Some(coding) }
}
