//! Validation during training, and evaluation after it.

use std::collections::HashSet;
use std::path::Path;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

use burn::tensor::Device;
use clift_data::{ClipReader, SceneSource, Split};
use clift_eval::{
    EvalConfig, EvalError, EvalFrames, EvalModels, Evaluator, ExternalMethod, Method, RunDescription, SceneFigures,
    SceneLimits, Summary, Sweep, training_scenes_note,
};
use clift_model::{Network, TokenCount, TrainedModel};
use clift_scene::TokenCoding;

use crate::config::config::Config;
use crate::distributed::ranks::Ranks;
use crate::error::TrainError;
use crate::events::{EvalEvents, Event, RunStep, Sink, Stage};
use crate::footprint::largest_tensor;
use crate::run::eval_folder::EvalFolder;
use crate::run::training_curves::training_curves;

/// Settings of an evaluation: methods, counts, and the output folder.
#[derive(Clone, Copy, Debug)]
pub struct EvalRequest<'a> {
    /// The split of the data set.
    pub split: Split,
    /// Methods of other programs, measured beside the model.
    pub external: &'a [ExternalMethod],
    /// Folder of the results.
    pub folder: &'a EvalFolder,
}

/// The validation and test views of a run.
pub struct Validation<'a> {
    config: &'a Config,
    evaluator: Evaluator,
}

impl<'a> Validation<'a> {
    /// Chooses the scenes and views among the `frames` of `reader` by `eval`, for an evaluation on `device`.
    ///
    /// # Errors
    /// As [`Evaluator::new`], and [`TrainError::BadConfig`] for tensors that the device cannot hold.
    pub fn new(
        config: &'a Config,
        eval: EvalConfig,
        reader: ClipReader,
        frames: EvalFrames,
        device: &Device,
        sink: &mut dyn Sink,
    ) -> Result<Self, TrainError> {
        largest_tensor::check_tensors(config, device, &[RunStep::Eval])?;
        let run_dir = &config.run_dir;
        let description = RunDescription {
            name: run_dir.file_name().unwrap_or(run_dir.as_os_str()).to_string_lossy().into_owned(),
            config: toml::to_string_pretty(config).map_err(TrainError::bad_file("config", run_dir))?,
            device: config.device.to_string(),
            command: std::env::args_os().map(|word| word.to_string_lossy().into_owned()).collect::<Vec<_>>().join(" "),
        };
        let evaluator = Evaluator::new(config.sweep(eval), description, reader, frames, device)?;
        if !evaluator.skip_report.skips.is_empty() {
            sink.event(&Event::Message(format!("evaluation: {}", evaluator.skip_report)));
        }
        let (text, warnings) = evaluator.describe();
        sink.event(&Event::Message(text));
        for warning in warnings {
            sink.event(&Event::Warning(warning));
        }
        Ok(Self { config, evaluator })
    }

    /// Marks the evaluated scenes that have the keys of training scenes, for the report; returns a warning if there are some.
    pub fn mark_training_scenes(&mut self, training: &dyn SceneSource) -> Option<String> {
        let keys: HashSet<&str> = (0..training.num_scenes()).map(|scene| training.key(scene)).collect();
        self.evaluator.training_scenes =
            self.evaluator.keys().filter(|key| keys.contains(key)).map(str::to_owned).collect();
        training_scenes_note(&self.evaluator.training_scenes)
    }

    /// Renders the context views of the evaluation too: on data that the model was not trained on they may be too far apart.
    pub fn check_contexts(&mut self) {
        self.evaluator.sweep.checks_contexts = true;
    }

    /// Measures a model without autodiff during training, the scenes shared by the ranks: with all tokens in stage 1, with
    /// one count of condensed tokens in stage 2. Writes the first contact sheet to `folder`. Returns the mean PSNR in dB;
    /// `None` if no view could be measured or `stop` is set.
    ///
    /// # Errors
    /// As [`Evaluator::measure`]; a scene that cannot be read is skipped.
    pub fn validate(
        &self,
        model: &Network,
        stage: Stage,
        step: u64,
        (folder, ranks): (&Path, &Ranks),
        stop: &AtomicBool,
        sink: &mut dyn Sink,
    ) -> Result<Option<f64>, TrainError> {
        let Config { eval: settings, clusters, model: sizes, .. } = self.config;
        let is_stage2 = stage == Stage::Stage2;
        let model = TrainedModel::snapshot(model, sizes, is_stage2);
        let mut models = EvalModels::new(model.clone());
        let (stored_tokens, method) = if is_stage2 {
            models.set_stage2(clusters.grouping, model);
            (settings.validation_stored_tokens, Method::condensed(clusters.grouping))
        } else {
            let architecture = sizes.architecture;
            let method = if architecture.supports_clusters() { Method::Kmeans } else { Method::Whole(architecture) };
            (TokenCount::Share(1.0), method)
        };
        let all = &self.evaluator.sweep;
        let eval = EvalConfig {
            stored_tokens: vec![stored_tokens],
            render: Vec::new(),
            formats: vec![TokenCoding::F32],
            methods: vec![method],
            ..all.eval.clone()
        };
        let sweep = Sweep { eval, ..all.clone() };
        let mut write_sheet = |_: &str, figures: SceneFigures| {
            let making = |source| EvalError::Io { action: "making a folder", source, path: folder.into() };
            std::fs::create_dir_all(folder).map_err(making)?;
            figures.contact_sheet.write_png(&folder.join(format!("step-{step:09}.png")))
        };
        let limits = SceneLimits { num_scenes: settings.num_validation_scenes, num_figures: 1 };
        let mut progress = EvalEvents { stop, sink, ranks, is_stage: false };
        let measured = match self.evaluator.measure(&models, &sweep, limits, &mut write_sheet, &mut progress) {
            Err(EvalError::Interrupted { .. }) => return Ok(None),
            measured => measured?.0,
        };
        let summary = Summary::new(&measured);
        let Some(point) = summary.points.first() else { return Ok(None) };
        let (psnr, ssim) = (point.quality.psnr.unwrap_or(f64::NAN), point.quality.ssim);
        sink.event(&Event::Evaluated { stage, step, psnr, ssim, num_views: summary.num_views });
        Ok(point.quality.psnr.filter(|psnr| psnr.is_finite()))
    }

    /// Evaluates models on the views of this validation, the scenes shared by the ranks.
    pub fn evaluate(
        &self,
        models: &EvalModels,
        request: &EvalRequest,
        ranks: &Ranks,
        stop: &AtomicBool,
        sink: &mut dyn Sink,
    ) -> Result<Summary, TrainError> {
        let started = Instant::now();
        let mut progress = EvalEvents { stop, sink, ranks, is_stage: true };
        let training = training_curves(&self.config.run_dir);
        let summary =
            self.evaluator.evaluate(models, request.external, training, request.folder.path(), &mut progress)?;
        sink.event(&Event::StepFinished { run_step: RunStep::Eval, elapsed_s: started.elapsed().as_secs_f64() });
        Ok(summary)
    }
}
