//! An evaluation: measures trained models on scenes they were not trained on and writes the results.

use std::path::Path;

use burn::tensor::Device;
use clift_data::{ClipReader, EvaluationItem, SkipReport, replace_file};
use clift_model::ModelError;

use crate::config::eval_config::EvalConfig;
use crate::config::method::Method;
use crate::error::EvalError;
use crate::evaluator::items::evaluation_items;
use crate::evaluator::progress::Progress;
use crate::evaluator::sheets::Sheets;
use crate::figures::scene_figure::SceneFigures;
use crate::metrics::lpips::{LPIPS_COMMAND, LPIPS_MIN_SIZE_PX, Lpips};
use crate::report::page::{MAX_EXHIBITS, Report};
use crate::statistics::eval_results::EvalResults;
use crate::statistics::scenes_csv::write_scenes;
use crate::statistics::summary::Summary;
use crate::sweep::eval_models::EvalModels;
use crate::sweep::evaluate_scene::evaluate_scene;
use crate::sweep::predictions::{ExternalMethod, picture_name};
use crate::sweep::sweep::Sweep;

/// The scenes and views of an evaluation, and what is measured of each scene.
pub struct Evaluator {
    eval: EvalConfig,
    sweep: Sweep,
    description: Description,
    reader: ClipReader,
    items: Vec<EvaluationItem>,
    ledger: SkipReport,
    device: Device,
}

/// What a report states about the evaluated run.
#[derive(Clone, Debug)]
pub struct Description {
    /// Name of the run.
    pub name: String,
    /// The config of the run, as TOML.
    pub config: String,
    /// Name of the device.
    pub device: String,
}

impl Evaluator {
    /// Chooses the scenes of `reader` and the views that `eval` names. `sweep` holds the settings of every scene: token
    /// counts and formats as in `eval`; methods, LPIPS and other systems are added by [`evaluate`](Self::evaluate).
    ///
    /// # Errors
    /// As [`evaluation_items`], [`ModelError::BadConfig`] for a count that a scene does not have or a precision that the
    /// device does not have.
    pub fn new(
        eval: EvalConfig,
        sweep: Sweep,
        description: Description,
        reader: ClipReader,
        device: &Device,
    ) -> Result<Self, EvalError> {
        eval.precision.check("eval.precision", device)?;
        let (items, ledger) = evaluation_items(&eval, &reader)?;
        // Checked here, so that a run does not fail after training.
        let tokens_per_view = sweep.model.num_tokens(1, reader.options.height, reader.options.width)?;
        let fewest_views = items.iter().map(|item| item.views.context.len()).min().unwrap_or_default();
        check_counts(&eval, fewest_views * tokens_per_view)?;
        Ok(Self { eval, sweep, description, reader, items, ledger, device: device.clone() })
    }

    /// Which scenes were skipped when the views were chosen.
    pub fn ledger(&self) -> &SkipReport {
        &self.ledger
    }

    /// The settings of every scene.
    pub fn sweep(&self) -> &Sweep {
        &self.sweep
    }

    /// Measures every scene and writes `report.html`, `summary.json`, `scenes.csv`, `views.csv`, `skipped.json` and the
    /// contact sheets to `folder`. The images of `systems` are scored too.
    ///
    /// # Errors
    /// As [`measure`](Self::measure), [`ModelError::BadConfig`] for a method without weights, [`EvalError::NoScenes`] when
    /// every scene failed, [`EvalError::NoPredictions`] for a system without any image.
    pub fn evaluate(
        &self,
        models: &EvalModels,
        systems: &[ExternalMethod],
        folder: &Path,
        progress: &mut dyn Progress,
    ) -> Result<Summary, EvalError> {
        let lpips = self.lpips(progress)?;
        let variants = self.methods(models)?;
        let sweep = Sweep { variants, lpips: lpips.clone().ok(), systems: systems.to_vec(), ..self.sweep.clone() };
        progress.done(0, self.items.len());
        let sheets = Sheets::new(folder)?;
        let mut exhibits = Vec::new();
        let mut show = |key: &str, shown: SceneFigures| {
            if exhibits.len() < MAX_EXHIBITS {
                exhibits.push(shown.exhibit);
            }
            sheets.add(&shown.sheet, key)
        };
        let limits = Limits { num_scenes: self.items.len(), num_shown: self.eval.num_sheets };
        let (mut measured, ledger) = self.measure(models, &sweep, limits, &mut show, progress)?;
        match &lpips {
            Ok(lpips) => measured.set_lpips_weights(lpips.sha256()),
            Err(reason) => measured.note_not_measured("lpips_vgg", reason.clone()),
        }
        let summary = Summary::new(&measured);
        if summary.num_views == 0 {
            return Err(EvalError::NoScenes { reason: "every scene of the evaluation failed".into() });
        }
        for system in systems {
            self.require_pictures(system, &summary)?;
        }
        sheets.keep()?;
        summary.write(&folder.join("summary.json"))?;
        write_scenes(&measured, &folder.join("scenes.csv"))?;
        measured.write_views(&folder.join("views.csv"))?;
        write_ledger(&ledger, &folder.join("skipped.json"))?;
        let Description { name, config, device } = self.description.clone();
        let report = Report { name, summary: summary.clone(), ledger, exhibits, config, device };
        report.write(&folder.join("report.html"))?;
        Ok(summary)
    }

    /// Measures the first scenes with `sweep` and passes figures of the first of them to `show`. Returns the
    /// measurements, and which scenes were skipped: those whose views could not be chosen or read.
    ///
    /// # Errors
    /// [`EvalError::Interrupted`] when `progress` asks to stop; as [`evaluate_scene`] and `show`.
    pub fn measure(
        &self,
        models: &EvalModels,
        sweep: &Sweep,
        limits: Limits,
        show: &mut dyn FnMut(&str, SceneFigures) -> Result<(), EvalError>,
        progress: &mut dyn Progress,
    ) -> Result<(EvalResults, SkipReport), EvalError> {
        let _precision = self.eval.precision.scope();
        let (mut measured, mut ledger) = (EvalResults::default(), self.ledger.clone());
        for skip in &ledger.skips {
            measured.skip(&skip.key);
        }
        let total = self.items.len().min(limits.num_scenes);
        for (i, item) in self.items.iter().take(total).enumerate() {
            if progress.is_interrupted() {
                return Err(EvalError::Interrupted { done: i, total });
            }
            let key = self.reader.source.key(item.scene);
            match self.reader.read(item.scene, &item.views) {
                Ok(clip) => {
                    let is_shown = i < limits.num_shown;
                    if let Some(results) = evaluate_scene(models, &clip, sweep, is_shown, &mut measured)? {
                        show(key, SceneFigures::new(&clip, &results, sweep.model.patch_size)?)?;
                    }
                }
                Err(error) => {
                    let reason = error.to_string();
                    measured.skip(key);
                    progress.skipped(key, &reason);
                    ledger.skip(key, reason);
                }
            }
            progress.done(i + 1, total);
        }
        Ok((measured, ledger))
    }

    /// LPIPS, or the reason why it is not measured.
    fn lpips(&self, progress: &mut dyn Progress) -> Result<Result<Lpips, String>, EvalError> {
        let size = self.reader.options.width.min(self.reader.options.height);
        Ok(match self.eval.lpips_path() {
            _ if size < LPIPS_MIN_SIZE_PX => {
                Err(format!("pictures are below {LPIPS_MIN_SIZE_PX} x {LPIPS_MIN_SIZE_PX} pixels"))
            }
            Some(path) => {
                let lpips = Lpips::load(path, &self.device)?;
                progress.note(&format!("LPIPS: weights with SHA-256 {}", lpips.sha256()));
                Ok(lpips)
            }
            None => Err(format!("eval.lpips_weights is not set; `{LPIPS_COMMAND}` makes the file")),
        })
    }

    /// A folder without a single image is a wrong path, not a system that misses all.
    fn require_pictures(&self, system: &ExternalMethod, summary: &Summary) -> Result<(), EvalError> {
        if summary.points.iter().any(|point| point.variant == system.setting().variant) {
            return Ok(());
        }
        let first = self.items.first().and_then(|item| {
            let frame = item.views.target.first()?;
            Some(picture_name(self.reader.source.key(item.scene), *frame))
        });
        let (name, first, path) = (system.name.as_str(), first.unwrap_or_default(), system.folder.clone());
        Err(EvalError::NoPredictions { name, expected: summary.num_views, first, path })
    }

    /// The methods of the config, or all with weights.
    fn methods(&self, models: &EvalModels) -> Result<Vec<Method>, EvalError> {
        let asked = &self.eval.variants;
        if asked.is_empty() {
            return Ok(models.methods());
        }
        let Some(method) = asked.iter().find(|method| models.for_method(**method).is_none()) else {
            return Ok(asked.clone());
        };
        let fix = match method {
            Method::Clift => "stage 2 was not trained on clusters of K-means: leave it out",
            Method::PatchClift => {
                "stage 2 was not trained on tiles: train a run with clusters.grouping = \"tile\" and \
                 stage1.init_from this one, and evaluate it with --with"
            }
            _ => "baselines are always measured: leave it out",
        };
        let (value, fix) = (method.name().into(), fix.into());
        Err(ModelError::BadConfig { key: "eval.variants", value, fix }.into())
    }
}

/// How many scenes are measured, and of how many of them figures are made.
#[derive(Clone, Copy, Debug)]
pub struct Limits {
    /// Scenes that are measured, from the first.
    pub num_scenes: usize,
    /// Scenes with figures, from the first.
    pub num_shown: usize,
}

/// Refuses counts that a scene with `fewest_tokens` does not have, and render counts that no scene would use.
fn check_counts(eval: &EvalConfig, fewest_tokens: usize) -> Result<(), EvalError> {
    let bad = |key, value: String, fix| Err(ModelError::BadConfig { key, value, fix }.into());
    let counts = eval.storage.iter().map(|count| ("eval.storage", count));
    for (key, count) in counts.chain([("eval.validation_storage", &eval.validation_storage)]) {
        if count.of(fewest_tokens).is_err() {
            let fix = format!("write at most {fewest_tokens}, the fewest tokens of an evaluated scene");
            return bad(key, count.to_string(), fix);
        }
    }
    let most_stored = eval.storage.iter().filter_map(|count| count.of(fewest_tokens).ok()).max().unwrap_or_default();
    for count in &eval.render {
        if !count.of(most_stored).is_ok_and(|rendered| rendered < most_stored) {
            let fix = format!("write less than {most_stored}, the most tokens that every scene stores");
            return bad("eval.render", count.to_string(), fix);
        }
    }
    Ok(())
}

/// Writes which scenes were skipped, and why.
///
/// # Errors
/// [`EvalError::Io`].
pub fn write_ledger(ledger: &SkipReport, path: &Path) -> Result<(), EvalError> {
    let text = serde_json::to_vec_pretty(ledger).map_err(std::io::Error::from);
    text.and_then(|text| replace_file(path, &text)).map_err(EvalError::io("writing what was left out", path))
}
