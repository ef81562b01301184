//! A scene file from captured images, with a report.

use std::path::{Path, PathBuf};

use clift_data::ClipReader;
use clift_model::{ModelError, SelectionPreset, TrainedModel};

use crate::check::{CheckedView, nearest_image, read_other};
use crate::codec::token_codec::TokenCodec;
use crate::encode::contexts::EncodeOptions;
use crate::encode::encode::{EncodedScene, encode};
use crate::encode::refine::refine;
use crate::error::SceneError;
use crate::scene::scene::Scene;
use crate::scene::scene_renderer::SceneRenderer;
use crate::scene::token_coding::{CodedLoss, TokenCoding, TokenFormat};

/// Settings of [`encode_scene`].
#[derive(Clone, Debug, Default)]
pub struct SceneOptions {
    /// Contexts and tokens.
    pub encode: EncodeOptions,
    /// Steps that fit the tokens of each group to the photos, for a scene of several groups; 0 for none.
    pub refine_steps: usize,
    /// How tokens are stored; by default coded with a loss of 0.02 dB if the model has a codec, else in f16.
    pub coding: Option<TokenCoding>,
    /// The weight file, whose folder has the codec.
    pub weights: PathBuf,
    /// The scene file to write.
    pub out: PathBuf,
}

/// A scene file that was written.
#[derive(Clone, Debug)]
pub struct WrittenScene {
    /// The scene. Coded tokens have the values of the file, others are not rounded.
    pub encoded: EncodedScene,
    /// How the tokens are stored, such as "f16" or "coded, expected loss 0.02 dB".
    pub stored: String,
    /// Size of the file in bytes.
    pub file_bytes: u64,
    /// File name of every frame; empty for frames without files.
    pub frame_names: Vec<String>,
    /// Number of frames of the scene.
    pub num_frames: usize,
    /// Context views, rendered: at most 16, spread over all.
    pub contexts: Vec<CheckedView>,
    /// Frames that are not context views, rendered: those held out, or one; none if no other frame can be read.
    pub others: Vec<CheckedView>,
}

impl WrittenScene {
    /// Returns the file name of a frame, or its position if it has no file.
    pub fn frame_name(&self, frame: usize) -> String {
        self.frame_names.get(frame).cloned().unwrap_or_else(|| frame.to_string())
    }
}

/// Encodes scene `index` of `reader`, fits its tokens if that is chosen, writes its file, and compares renderings of it with the
/// photos. `progress` gets the numbers of fitted and of all groups.
pub fn encode_scene(
    model: &TrainedModel,
    reader: &ClipReader,
    index: usize,
    options: &SceneOptions,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<WrittenScene, SceneError> {
    let (frame_names, num_frames) = (reader.source.frame_names(index)?, reader.source.num_frames(index)?);
    let codec = codec_for(options.coding, &options.weights, model)?;
    let mut encoded = encode(model, reader, index, &options.encode)?;
    if options.refine_steps > 0 && encoded.scene.groups.len() > 1 && encoded.scene.model.has_patch_tokens() {
        let EncodedScene { scene, context, .. } = &mut encoded;
        refine(model, context, scene, (options.refine_steps, options.encode.seed), progress)?;
    }
    let stored = write(&mut encoded.scene, codec, options)?;
    let EncodedScene { scene, context, .. } = &encoded;
    let is_context = |frame: &usize| context.frame_index.contains(frame);
    let held_out: Vec<usize> = match options.encode.hold_out {
        0 => Vec::new(),
        every => reader.source.held_out(index, every)?.into_iter().filter(|frame| !is_context(frame)).collect(),
    };
    let others = match held_out[..] {
        [] => read_other(reader, index, scene)?,
        _ => Some(reader.read_views(index, &held_out, &scene.world)?),
    };
    let (renderer, rules) = (model.network.renderer.clone(), SelectionPreset::Paper.rules());
    let mut renderer = SceneRenderer::new(scene, renderer, rules, &model.device)?;
    let contexts = CheckedView::contexts(&mut renderer, context)?;
    let nearest = |c2w| nearest_image(context, c2w);
    let others = others.map_or(Ok(Vec::new()), |others| CheckedView::compare(&mut renderer, &others, nearest))?;
    let file_bytes = std::fs::metadata(&options.out).map_or(0, |file| file.len());
    Ok(WrittenScene { encoded, stored, file_bytes, frame_names, num_frames, contexts, others })
}

/// Reads the codec beside the weights that a coding needs, with the loss: by default the default loss if there is a codec.
/// `None` for tokens as plain numbers.
fn codec_for(
    coding: Option<TokenCoding>,
    weights: &Path,
    model: &TrainedModel,
) -> Result<Option<(TokenCodec, CodedLoss)>, SceneError> {
    let architecture = model.config.architecture;
    match coding {
        Some(TokenCoding::Plain(_)) => Ok(None),
        Some(TokenCoding::Coded(_)) if !architecture.supports_clusters() => Err(SceneError::request(format!(
            "the tokens of {architecture} have no codec; store them with --format f32 or f16"
        ))),
        Some(TokenCoding::Coded(loss)) => match TokenCodec::beside(weights, model)? {
            Some(codec) => Ok(Some((codec, loss))),
            None => Err(ModelError::NoCodec { path: TokenCodec::path_of(weights) }.into()),
        },
        None => Ok(TokenCodec::beside(weights, model)?.map(|codec| (codec, CodedLoss::default()))),
    }
}

/// Writes a scene, whose tokens become those of a coded file, and returns how they are stored.
fn write(
    scene: &mut Scene,
    codec: Option<(TokenCodec, CodedLoss)>,
    options: &SceneOptions,
) -> Result<String, SceneError> {
    let Some((codec, loss)) = codec else {
        let format = match options.coding {
            Some(TokenCoding::Plain(format)) => format,
            _ => TokenFormat::F16,
        };
        scene.write(&options.out, format)?;
        return Ok(format.to_string());
    };
    let num_tokens = scene.model.num_tokens(scene.num_members(), scene.height, scene.width)?;
    let share = scene.num_tokens() as f64 / num_tokens as f64;
    let step = codec.rates.step_for_loss(share, loss.db()) as f32;
    scene.write_coded(&options.out, &codec, step)?;
    scene.tokens = scene.rounded_tokens(&codec, step)?;
    Ok(format!("coded, expected loss {} dB", loss.db()))
}
