//! Evaluation of trained models on test scenes, with all output files.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use burn::tensor::Device;
use clift_core::{plural, replace_file};
use clift_data::{ClipReader, EvaluationItem, SkipReport};
use clift_model::{Architecture, LPIPS_COMMAND, LPIPS_MIN_SIZE_PX, Lpips, ModelError};
use clift_scene::TokenCoding;

use crate::config::eval_config::EvalConfig;
use crate::config::method::Method;
use crate::config::split::{EvalFrames, EvalSplit};
use crate::error::EvalError;
use crate::evaluator::items::evaluation_items;
use crate::evaluator::sheets::Sheets;
use crate::figures::canvas::Canvas;
use crate::figures::contact_sheet::contact_sheet;
use crate::report::page::{MAX_FIGURES, Report, RunDescription};
use crate::statistics::csv_files::{write_scenes, write_views};
use crate::statistics::eval_results::EvalResults;
use crate::statistics::summary::{Summary, context_targets_note};
use crate::sweep::eval_models::EvalModels;
use crate::sweep::evaluate_scene::evaluate_scene;
use crate::sweep::sweep::Sweep;

/// The scenes and views of an evaluation, and the settings of every scene.
pub struct Evaluator {
    /// The settings of every scene.
    pub sweep: Sweep,
    description: RunDescription,
    reader: ClipReader,
    items: Vec<EvaluationItem>,
    split: EvalSplit,
    /// The scenes that were skipped when the views were chosen.
    pub skip_report: SkipReport,
    /// Keys of the scenes that the models were trained on.
    pub training_scenes: BTreeSet<String>,
    device: Device,
}

impl Evaluator {
    /// Chooses the scenes and views of `sweep.eval` from the `frames` of `reader`. [`evaluate`](Self::evaluate) adds LPIPS
    /// to `sweep`.
    pub fn new(
        sweep: Sweep,
        description: RunDescription,
        reader: ClipReader,
        frames: EvalFrames,
        device: &Device,
    ) -> Result<Self, EvalError> {
        let eval = &sweep.eval;
        eval.precision.check("eval.precision", device)?;
        let (items, skip_report, split) = evaluation_items(eval, &reader, frames)?;
        // An early check: a run must not fail after training.
        let tokens_per_view = sweep.model.num_patches(1, reader.options.height, reader.options.width)?;
        let fewest_views = items.iter().map(|item| item.views.context.len()).min().unwrap_or_default();
        check_counts(eval, fewest_views * tokens_per_view, sweep.model.architecture)?;
        let (training_scenes, device) = (BTreeSet::new(), device.clone());
        Ok(Self { sweep, description, reader, items, split, skip_report, training_scenes, device })
    }

    /// Returns the keys of the measured scenes.
    pub fn keys(&self) -> impl Iterator<Item = &str> {
        self.items.iter().map(|item| self.reader.source.key(item.scene))
    }

    /// Returns what is measured: scenes, targets and split, then warnings about figures that mislead.
    pub fn describe(&self) -> (String, Vec<String>) {
        let num_targets: usize = self.items.iter().map(|item| item.views.target.len()).sum();
        let num_given = self.items.iter().map(|item| item.views.num_context_targets()).sum();
        let num_scenes = plural(self.items.len(), "scene");
        let text = format!("evaluation: {num_scenes}, {}: {}", plural(num_targets, "target view"), self.split);
        (text, self.split.warning().map(str::to_owned).into_iter().chain(context_targets_note(num_given)).collect())
    }

    /// Measures every scene, and writes `report.html`, `summary.json`, `scenes.csv`, `views.csv`, `skipped.json` and the
    /// contact sheets to `folder`.
    ///
    /// # Errors
    /// As [`measure`](Self::measure), [`ModelError::BadWeights`] for unusable LPIPS weights, [`ModelError::BadConfig`] for a
    /// method without weights, [`EvalError::NoScenes`] when every scene failed, and [`EvalError::Io`].
    pub fn evaluate(
        &self,
        models: &EvalModels,
        folder: &Path,
        stop: &AtomicBool,
        progress: &mut dyn FnMut(EvalEvent),
    ) -> Result<Summary, EvalError> {
        let lpips = self.lpips(progress)?;
        let (methods, formats) = (self.methods(models)?, self.formats(models, progress)?);
        let sweep = Sweep {
            eval: EvalConfig { methods, formats, ..self.sweep.eval.clone() },
            lpips: lpips.clone().ok(),
            ..self.sweep.clone()
        };
        progress(EvalEvent::Done(0, self.items.len()));
        let sheets = Sheets::new(folder)?;
        let mut shown = Vec::new();
        let mut keep_sheet = |key: &str, sheet: Canvas| {
            sheets.add(&sheet, key)?;
            if shown.len() < MAX_FIGURES {
                shown.push((key.to_owned(), sheet));
            }
            Ok(())
        };
        let limits = SceneLimits { num_scenes: self.items.len(), num_sheets: self.sweep.eval.num_sheets };
        let (mut measured, skipped) = self.measure(models, &sweep, limits, &mut keep_sheet, stop, progress)?;
        match &lpips {
            Ok(lpips) => measured.facts.lpips_weights_sha256 = Some(lpips.sha256().into()),
            Err(reason) => measured.note_not_measured("lpips_vgg", reason.clone()),
        }
        let summary = Summary::new(&measured);
        if summary.num_views == 0 {
            let first = skipped.skips.first().map(|skip| format!(", first {}: {}", skip.key, skip.reason));
            let reason = format!("every scene of the evaluation failed{}", first.unwrap_or_default());
            return Err(EvalError::NoScenes { reason });
        }
        let complete = folder.join("summary.json");
        // Last: an evaluation with a summary is complete. That of a former evaluation goes first.
        if complete.exists() {
            std::fs::remove_file(&complete).map_err(EvalError::io("removing the former summary", &complete))?;
        }
        sheets.keep()?;
        write_scenes(&measured, &folder.join("scenes.csv"))?;
        write_views(&measured, &folder.join("views.csv"))?;
        write_skip_report(&skipped, &folder.join("skipped.json"))?;
        let report = Report { run: self.description.clone(), summary: summary.clone(), skipped, sheets: shown };
        report.write(&folder.join("report.html"))?;
        summary.write(&complete)?;
        Ok(summary)
    }

    /// Measures the first scenes with `sweep`, and passes the contact sheets of the first of them to `keep_sheet`. Returns
    /// the metrics, and the scenes whose views could not be chosen or read.
    ///
    /// # Errors
    /// [`EvalError::Interrupted`] when `stop` is set; as `evaluate_scene` and `keep_sheet`.
    pub fn measure(
        &self,
        models: &EvalModels,
        sweep: &Sweep,
        limits: SceneLimits,
        keep_sheet: &mut dyn FnMut(&str, Canvas) -> Result<(), EvalError>,
        stop: &AtomicBool,
        progress: &mut dyn FnMut(EvalEvent),
    ) -> Result<(EvalResults, SkipReport), EvalError> {
        let _precision = self.sweep.eval.precision.scope();
        let (mut measured, mut skip_report) = (EvalResults::default(), self.skip_report.clone());
        measured.facts.split = Some(self.split);
        measured.facts.training_scenes.clone_from(&self.training_scenes);
        measured.skipped.extend(skip_report.skips.iter().map(|skip| skip.key.clone()));
        let total = self.items.len().min(limits.num_scenes);
        for (i, item) in self.items.iter().take(total).enumerate() {
            if stop.load(Ordering::Relaxed) {
                return Err(EvalError::Interrupted { done: i, total });
            }
            let key = self.reader.source.key(item.scene);
            match self.reader.read(item.scene, &item.views) {
                Ok(clip) => {
                    let keep_images = i < limits.num_sheets;
                    if let Some(results) = evaluate_scene(models, &clip, sweep, keep_images, &mut measured)? {
                        keep_sheet(key, contact_sheet(&clip, &results)?)?;
                    }
                }
                Err(error) => {
                    let reason = error.to_string();
                    progress(EvalEvent::Skipped(key, &reason));
                    measured.skipped.insert(key.into());
                    skip_report.skip(key, reason);
                }
            }
            progress(EvalEvent::Done(i + 1, total));
        }
        Ok((measured, skip_report))
    }

    /// Returns the formats of the stored tokens, without coded ones if the model has no codec.
    fn formats(&self, models: &EvalModels, progress: &mut dyn FnMut(EvalEvent)) -> Result<Vec<TokenCoding>, EvalError> {
        let mut formats = self.sweep.eval.formats.clone();
        let mut seen = BTreeSet::new();
        formats.retain(|format| seen.insert(*format));
        let is_coded = |format: &TokenCoding| matches!(format, TokenCoding::Coded(_));
        if let Some(coded) = formats.iter().copied().find(is_coded).filter(|_| models.codec.is_none()) {
            let fix = "the model has no token codec: fit it with `clift codec RUN`";
            formats.retain(|format| !is_coded(format));
            if formats.is_empty() {
                let (value, fix) = (coded.to_string(), fix.into());
                return Err(ModelError::BadConfig { key: "eval.formats", value, fix }.into());
            }
            progress(EvalEvent::Note(&format!("{coded} tokens are left out: {fix}")));
        }
        Ok(formats)
    }

    /// Loads LPIPS, or returns the reason why LPIPS is not measured.
    fn lpips(&self, progress: &mut dyn FnMut(EvalEvent)) -> Result<Result<Lpips, String>, EvalError> {
        let size = self.reader.options.width.min(self.reader.options.height);
        Ok(match self.sweep.eval.lpips_path() {
            _ if size < LPIPS_MIN_SIZE_PX => {
                Err(format!("images are smaller than {LPIPS_MIN_SIZE_PX} x {LPIPS_MIN_SIZE_PX} pixels"))
            }
            Some(path) => {
                let lpips = Lpips::load(path, &self.device)?;
                progress(EvalEvent::Note(&format!("LPIPS: weights with SHA-256 {}", lpips.sha256())));
                Ok(lpips)
            }
            None => Err(format!("eval.lpips_weights is not set; make the file with `{LPIPS_COMMAND}`")),
        })
    }

    /// Returns the methods of the config, or all methods with weights. Networks without clusters
    /// beside the run are always measured.
    fn methods(&self, models: &EvalModels) -> Result<Vec<Method>, EvalError> {
        let requested = &self.sweep.eval.methods;
        if requested.is_empty() {
            return Ok(models.methods());
        }
        let Some(method) = requested.iter().find(|method| models.for_method(**method).is_none()) else {
            let beside = Method::whole().filter(|method| models.for_method(*method).is_some());
            let beside = beside.filter(|method| !requested.contains(method));
            return Ok(requested.iter().copied().chain(beside).collect());
        };
        let architecture = models.stage1.config.architecture;
        let fix = match method {
            _ if !architecture.supports_clusters() => format!(
                "a run with model.architecture = \"{architecture}\" has the method {} alone; leave the key and --preset \
                 out",
                Method::Whole(architecture).name()
            ),
            Method::Whole(other) => {
                format!("the run is another network; add runs with model.architecture = \"{other}\" with --with")
            }
            Method::Clift => "stage 2 was not trained on K-means clusters; remove the method".into(),
            Method::TileClift => "stage 2 was not trained on tiles; train a run with clusters.grouping = \"tile\" and \
                                  stage1.init_from = this run, and pass the new run with --with"
                .into(),
            _ => "baselines are always measured; remove the method".into(),
        };
        let value = method.name().into();
        Err(ModelError::BadConfig { key: "eval.methods", value, fix }.into())
    }
}

/// Progress of an evaluation.
#[derive(Clone, Copy, Debug)]
pub enum EvalEvent<'a> {
    /// Number of scenes that are done, of all. The first event has 0.
    Done(usize, usize),
    /// A line of text.
    Note(&'a str),
    /// Key of a skipped scene, and the reason.
    Skipped(&'a str, &'a str),
}

/// Numbers of measured scenes and of scenes with contact sheets.
#[derive(Clone, Copy, Debug)]
pub struct SceneLimits {
    /// Number of measured scenes, from the first.
    pub num_scenes: usize,
    /// Number of scenes with contact sheets, from the first.
    pub num_sheets: usize,
}

/// Refuses storage counts above `fewest_tokens`, the smallest scene, and render counts that no scene would use: a network
/// without clusters stores and renders all tokens.
fn check_counts(eval: &EvalConfig, fewest_tokens: usize, architecture: Architecture) -> Result<(), EvalError> {
    let bad = |key, value: String, fix| Err(ModelError::BadConfig { key, value, fix }.into());
    if eval.formats.is_empty() {
        return bad("eval.formats", "[]".into(), "write at least one format".into());
    }
    if !architecture.supports_clusters() {
        let Some(count) = eval.render.first() else { return Ok(()) };
        let fix = format!("views of {architecture} are rendered from all tokens: write []");
        return bad("eval.render", count.to_string(), fix);
    }
    let counts = eval.stored_tokens.iter().map(|count| ("eval.stored_tokens", count));
    for (key, count) in counts.chain([("eval.validation_stored_tokens", &eval.validation_stored_tokens)]) {
        if count.of(fewest_tokens).is_err() {
            let fix = format!("write at most {fewest_tokens}, the fewest tokens of an evaluated scene");
            return bad(key, count.to_string(), fix);
        }
    }
    let most_stored =
        eval.stored_tokens.iter().filter_map(|count| count.of(fewest_tokens).ok()).max().unwrap_or_default();
    for count in &eval.render {
        if !count.of(most_stored).is_ok_and(|rendered| rendered < most_stored) {
            let fix = format!("write less than {most_stored}, the most tokens that every scene stores");
            return bad("eval.render", count.to_string(), fix);
        }
    }
    Ok(())
}

/// Writes skipped scenes with their reasons as JSON.
pub fn write_skip_report(skip_report: &SkipReport, path: &Path) -> Result<(), EvalError> {
    let text = serde_json::to_vec_pretty(skip_report).map_err(std::io::Error::from);
    text.and_then(|text| replace_file(path, &text)).map_err(EvalError::io("writing the skipped scenes", path))
}
