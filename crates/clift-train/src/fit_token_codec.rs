//! The token codec of a run or model, fitted after stage 2 or on demand.

use std::path::Path;
use std::sync::atomic::AtomicBool;

use burn::tensor::Device;
use clift_core::{derive_seed, plural};
use clift_data::ClipReader;
use clift_eval::{EvalConfig, EvalError, EvalFrames, EvalSplit, evaluation_items};
use clift_model::{Grouping, ModelPath, TrainedModel};
use clift_scene::{CodecOptions, SceneError, TokenCodec, fit_codec};

use crate::config::config::Config;
use crate::error::{TrainError, bad};
use crate::events::{Event, Sink};

/// Fits the token codec of a model on training scenes, with the token counts and views of `config.eval`, and writes the
/// codec beside the weights. Returns the number of scenes that it was fitted on.
pub fn fit_token_codec(
    config: &Config,
    model: (&TrainedModel, &Path),
    (reader, frames): (&ClipReader, EvalFrames),
    stop: &AtomicBool,
    sink: &mut dyn Sink,
) -> Result<usize, TrainError> {
    let (model, weights) = model;
    if !config.model.architecture.supports_clusters() {
        let fix = "the token codec is one of condensed tokens; those of this network are stored in f32 or f16";
        return Err(bad("model.architecture", format!("\"{}\"", config.model.architecture), fix));
    }
    if config.clusters.grouping != Grouping::Kmeans {
        let grouping: &str = config.clusters.grouping.into();
        let fix = "the token codec is one of K-means tokens; tokens of other groups are stored in f32 or f16";
        return Err(bad("clusters.grouping", format!("\"{grouping}\""), fix));
    }
    let source = &reader.source;
    let num_training =
        |scene| Some(source.num_frames(scene).ok()? - source.held_out(scene, frames.hold_out).ok()?.len());
    let longest = (0..source.num_scenes()).filter_map(num_training).max();
    // A capture of few photos has fewer targets.
    let most_targets = longest.unwrap_or_default().saturating_sub(config.eval.num_context);
    let num_targets = config.eval.num_targets.min(most_targets.max(1));
    let eval = EvalConfig { index: None, num_scenes: 0, num_targets, ..config.eval.clone() };
    let (items, ..) = evaluation_items(&eval, reader, frames)?;
    let options = CodecOptions {
        counts: eval.stored_tokens,
        kmeans: config.clusters.kmeans.clone(),
        seed: derive_seed(config.seed, "codec"),
    };
    let mut skipped = |key: &str, reason: &str| sink.event(&Event::Skipped { key: key.into(), reason: reason.into() });
    let (codec, num_scenes) = fit_codec(model, reader, &items, &options, stop, &mut skipped)?;
    codec.write(&TokenCodec::path_of(weights))?;
    Ok(num_scenes)
}

/// Fits the codec of a run that has none of its weights. Scenes without views leave the run without a codec.
pub(crate) fn ensure_codec(
    config: &Config,
    weights: &Path,
    device: &Device,
    training: &ClipReader,
    stop: &AtomicBool,
    sink: &mut dyn Sink,
) -> Result<(), TrainError> {
    let path = ModelPath { dir: config.run_dir.clone(), weights: weights.into() };
    if config.clusters.grouping != Grouping::Kmeans || !weights.exists() {
        return Ok(());
    }
    let model = TrainedModel::open_with(&path, &config.model, device)?;
    if matches!(TokenCodec::beside(weights, &model), Ok(Some(_))) {
        return Ok(());
    }
    // Held-out frames are not in the reader.
    let data = (training, EvalFrames::whole(EvalSplit::Train));
    match fit_token_codec(config, (&model, weights), data, stop, sink) {
        Ok(num_scenes) => {
            sink.event(&Event::Message(format!("token codec: fitted on {}", plural(num_scenes, "training scene"))));
            Ok(())
        }
        Err(TrainError::Eval(EvalError::NoScenes { reason }) | TrainError::Scene(SceneError::NoScenes { reason })) => {
            sink.event(&Event::Warning(format!("the token codec is not fitted: {reason}; fit it with `clift codec`")));
            Ok(())
        }
        Err(error) => Err(error),
    }
}
