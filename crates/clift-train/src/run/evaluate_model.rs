//! The models of an evaluation: of other runs beside a run, and a model without a run, imported or a weight file.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use burn::tensor::Device;
use clift_data::{ClipReader, Split, open_dataset};
use clift_eval::{EvalFrames, EvalModels, EvalSplit, Method, Summary};
use clift_model::{ModelConfig, ModelError, ModelPath, TrainedModel};
use clift_scene::TokenCodec;

use crate::config::config::Config;
use crate::error::{TrainError, bad};
use crate::events::{Event, Sink, Stage};
use crate::run::eval_folder::EvalFolder;
use crate::run::validation::Validation;

/// Evaluates a model on a split of the data of `config`, and writes the results to a folder.
///
/// A model with a condenser is measured on condensed tokens only, unless `stage1` is given: the model it was trained from,
/// which renders the other methods.
///
/// In data without splits `data.hold_out` chooses the frames that a run with this key would hold out and measure; 0 for all.
///
/// # Errors
/// [`TrainError::BadFile`] when `stage1` has another encoder, [`TrainError::BadConfig`] for methods that
/// need `stage1`, [`TrainError::Model`] for heads that are not the model's, and those of data, models and evaluation.
pub fn evaluate_model(
    mut config: Config,
    model: &ModelPath,
    stage1: Option<&ModelPath>,
    (split, folder): (Split, &EvalFolder),
    stop: &AtomicBool,
    sink: &mut dyn Sink,
) -> Result<Summary, TrainError> {
    config.validate()?;
    let device = config.device.open()?;
    let last = TrainedModel::open_with(model, &config.model, &device)?;
    let mut models = EvalModels::new(match stage1 {
        Some(path) => TrainedModel::open_with(path, &config.model, &device)?,
        None => last.clone(),
    });
    if let Some(path) = stage1.filter(|_| !models.stage1.has_encoder_of(&last)) {
        let reason = format!("its encoder is not that of {}", model.weights.display());
        return Err(TrainError::bad_file("stage-1 model", &path.weights)(reason));
    }
    if last.has_condenser && stage1.is_none() {
        // Its renderer was trained on condensed tokens: other tokens would be no fair baseline.
        let own = Method::condensed(config.clusters.grouping);
        let methods = &mut config.eval.methods;
        if methods.is_empty() {
            methods.push(own);
        }
        if let Some(method) = methods.iter().find(|method| **method != own) {
            let fix = "give the stage-1 model, which renders this method, with --stage1";
            return Err(bad("eval.methods", method.name(), fix));
        }
    }
    if last.has_condenser {
        models.codec = TokenCodec::beside(&model.weights, &last)?.map(Arc::new);
        models.set_stage2(config.clusters.grouping, last);
    }
    let opened = open_dataset(&config.data, split, &mut |done, total| sink.event(&Event::Scan { done, total }))?;
    sink.event(&Event::Message(format!("{split}: {}", opened.report)));
    let mut frames = EvalFrames::new(&opened, split, 0, false);
    if frames.split == EvalSplit::OtherData && split == Split::Test {
        frames.hold_out = config.data.hold_out;
    }
    let reader = ClipReader { source: opened.source, options: config.data.clip_options() };
    let mut validation = Validation::new(&config, reader, frames, &device, sink)?;
    validation.evaluator.sweep.checks_contexts = true;
    validation.evaluate(&models, folder, stop, sink)
}

/// Opens the stage-2 model of the run of `config`, which must be trained on the encoder of `stage1`.
pub(crate) fn open_stage2(config: &Config, stage1: &TrainedModel) -> Result<TrainedModel, TrainError> {
    let found = weights(config, Stage::Stage2, "the weights of stage 2")?;
    let model = TrainedModel::open_with(&found, &config.model, &stage1.device)?;
    let path = found.weights;
    if !model.has_condenser {
        let reason = "the file has no condenser".into();
        return Err(ModelError::Weights { action: "reading", reason, path }.into());
    }
    if model.has_encoder_of(stage1) { Ok(model) } else { Err(TrainError::OtherEncoder { path }) }
}

/// Opens the model of a run of a network without clusters, for an evaluation of the run of `evaluated` with those of `others`.
pub(crate) fn open_whole(
    evaluated: &Config,
    config: &Config,
    others: &[TrainedModel],
    device: &Device,
) -> Result<TrainedModel, TrainError> {
    let [ours, theirs] = [evaluated, config].map(|config| config.data.clip_options());
    let refuse = |fix: &str| Err(bad("--with", config.run_dir.display(), fix));
    if theirs != ours {
        return refuse(
            "it was trained on images of another size or crop, or on other poses: choose a run with the same [data]",
        );
    }
    let kind = |model: &ModelConfig| (model.architecture, model.num_latents);
    if others.iter().any(|other| kind(&other.config) == kind(&config.model)) {
        return refuse("another run of this network has as many latents: choose runs with distinct model.num_latents");
    }
    let found = weights(config, Stage::Stage1, "the weights of stage 1")?;
    // All methods are drawn on as many patch grids.
    let model = ModelConfig { patch_grids: evaluated.model.patch_grids, ..config.model.clone() };
    Ok(TrainedModel::open_with(&found, &model, device)?)
}

/// Finds the weights of a stage, `what` in messages.
fn weights(config: &Config, stage: Stage, what: &'static str) -> Result<ModelPath, TrainError> {
    let path = config.run_dir.join(stage.name()).join("model.safetensors");
    if !path.exists() {
        return Err(TrainError::Missing { stage: "evaluation", what, first: "clift train", path });
    }
    Ok(ModelPath { dir: config.run_dir.clone(), weights: path })
}
