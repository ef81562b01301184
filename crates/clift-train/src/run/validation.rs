//! Validation during training, and evaluation after it.

use std::collections::HashSet;
use std::path::Path;
use std::sync::atomic::AtomicBool;
use std::time::Instant;

use burn::tensor::Device;
use clift_data::{ClipReader, SceneSource};
use clift_eval::{
    Canvas, EvalConfig, EvalError, EvalFrames, EvalModels, Evaluator, Method, RunDescription, SceneLimits, Summary,
    Sweep, training_scenes_note,
};
use clift_model::{Network, TokenCount, TrainedModel};
use clift_scene::TokenCoding;

use crate::config::config::Config;
use crate::error::TrainError;
use crate::events::{Event, RunStep, Sink, Stage, eval_events};
use crate::footprint::largest_tensor::check_tensors;
use crate::run::eval_folder::EvalFolder;

/// The validation and test views of a run.
pub struct Validation<'a> {
    config: &'a Config,
    pub(crate) evaluator: Evaluator,
}

impl<'a> Validation<'a> {
    /// Chooses the scenes and views among the `frames` of `reader`, for an evaluation on `device`.
    pub fn new(
        config: &'a Config,
        reader: ClipReader,
        frames: EvalFrames,
        device: &Device,
        sink: &mut dyn Sink,
    ) -> Result<Self, TrainError> {
        check_tensors(config, device, &[RunStep::Eval])?;
        let run_dir = &config.run_dir;
        let description = RunDescription {
            name: run_dir.file_name().unwrap_or(run_dir.as_os_str()).to_string_lossy().into_owned(),
            config: toml::to_string_pretty(config).map_err(TrainError::bad_file("config", run_dir))?,
            device: config.device.to_string(),
            command: std::env::args_os().map(|word| word.to_string_lossy().into_owned()).collect::<Vec<_>>().join(" "),
        };
        let evaluator = Evaluator::new(config.sweep(), description, reader, frames, device)?;
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

    /// Marks the evaluated scenes that have the keys of training scenes, for the report; warns if there are some.
    pub fn mark_training_scenes(&mut self, training: &dyn SceneSource, sink: &mut dyn Sink) {
        let keys: HashSet<&str> = (0..training.num_scenes()).map(|scene| training.key(scene)).collect();
        self.evaluator.training_scenes =
            self.evaluator.keys().filter(|key| keys.contains(key)).map(str::to_owned).collect();
        if let Some(warning) = training_scenes_note(&self.evaluator.training_scenes) {
            sink.event(&Event::Warning(warning));
        }
    }

    /// Measures a model without autodiff during training: with all tokens in stage 1, with one count of condensed tokens in
    /// stage 2. Writes the first contact sheet to `folder`. Returns whether there is a finite PSNR:
    /// there is none if no view could be measured, or if `stop` is set.
    pub fn validate(
        &self,
        model: &Network,
        stage: Stage,
        step: u64,
        folder: &Path,
        stop: &AtomicBool,
        sink: &mut dyn Sink,
    ) -> Result<bool, TrainError> {
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
        let mut write_sheet = |_: &str, sheet: Canvas| {
            let making = |source| EvalError::Io { action: "making a folder", source, path: folder.into() };
            std::fs::create_dir_all(folder).map_err(making)?;
            sheet.write_png(&folder.join(format!("step-{step:09}.png")))
        };
        let limits = SceneLimits { num_scenes: settings.num_validation_scenes, num_sheets: 1 };
        let measured =
            self.evaluator.measure(&models, &sweep, limits, &mut write_sheet, stop, &mut eval_events(sink, false));
        let measured = match measured {
            Err(EvalError::Interrupted { .. }) => return Ok(false),
            measured => measured?.0,
        };
        let summary = Summary::new(&measured);
        let Some(point) = summary.points.first() else { return Ok(false) };
        let (psnr, ssim) = (point.quality.psnr.unwrap_or(f64::NAN), point.quality.ssim);
        sink.event(&Event::Evaluated { stage, step, psnr, ssim, num_views: summary.num_views });
        Ok(psnr.is_finite())
    }

    /// Evaluates models on the views of this validation.
    pub fn evaluate(
        &self,
        models: &EvalModels,
        folder: &EvalFolder,
        stop: &AtomicBool,
        sink: &mut dyn Sink,
    ) -> Result<Summary, TrainError> {
        let started = Instant::now();
        let summary = self.evaluator.evaluate(models, folder.path(), stop, &mut eval_events(sink, true))?;
        sink.event(&Event::StepFinished { run_step: RunStep::Eval, elapsed_s: started.elapsed().as_secs_f64() });
        Ok(summary)
    }
}
