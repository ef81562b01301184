//! A scene file from captured images, with a report.

use std::path::PathBuf;

use clift_data::ClipReader;
use clift_model::TrainedModel;

use crate::check::view_check::{CheckedView, read_others, scene_renderer};
use crate::encode::coding::{Coder, Coding, count_for_bytes};
use crate::encode::contexts::Contexts;
use crate::encode::encode::{EncodedScene, encode};
use crate::encode::options::EncodeOptions;
use crate::error::SceneError;
use crate::fit::step_choice::{expected_step, step_for_bytes, step_for_loss};

/// Settings of [`encode_scene`].
#[derive(Clone, Debug, Default)]
pub struct SceneOptions {
    /// Contexts and tokens. With [`Coding::Bytes`], the default number of stored tokens is the one of the best expected PSNR.
    pub encode: EncodeOptions,
    /// How tokens are stored; by default coded with a loss of 0.02 dB if the model has a codec, else in f16.
    pub coding: Option<Coding>,
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
    /// Width and height of the images in pixels.
    pub image_size: [usize; 2],
    /// Width and height of the central part of the images that is used; `None` if that is nearly all.
    pub cropped: Option<[usize; 2]>,
    /// The context views, rendered.
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

/// Encodes scene `index` of `reader`, writes its file, and compares renderings of it with the photos.
///
/// # Errors
/// As [`encode`], [`ModelError::NoCodec`](clift_model::ModelError::NoCodec) without a codec that the coding needs,
/// [`ModelError::SceneFile`](clift_model::ModelError::SceneFile) for a file that cannot be written.
pub fn encode_scene(
    model: &TrainedModel,
    reader: &ClipReader,
    index: usize,
    options: &SceneOptions,
) -> Result<WrittenScene, SceneError> {
    let frame_names = reader.source.frame_names(index)?;
    let coder = Coder::new(options.coding, &options.weights, model)?;
    let stored_tokens = match (options.encode.stored_tokens, &coder) {
        (None, Coder::Bytes(codec, bytes)) => {
            let contexts = Contexts::choose(reader, index, &options.encode)?;
            let size = [reader.options.height, reader.options.width];
            Some(count_for_bytes((codec, *bytes), &contexts, size, &options.encode.model_path))
        }
        (stored_tokens, _) => stored_tokens,
    };
    let encode_options = EncodeOptions { stored_tokens, ..options.encode.clone() };
    let mut encoded = encode(model, reader, index, &encode_options)?;
    let stored = write(&coder, &mut encoded, options, (model, reader, index))?;
    let EncodedScene { scene, context, .. } = &encoded;
    let is_context = |frame: &usize| context.frame_index.contains(frame);
    let held_out: Vec<usize> = match options.encode.hold_out {
        0 => Vec::new(),
        every => reader.source.held_out(index, every)?.into_iter().filter(|frame| !is_context(frame)).collect(),
    };
    let others = match held_out[..] {
        [] => read_others(reader, index, scene, 1)?,
        _ => Some(reader.read_views(index, &held_out, &scene.world)?),
    };
    let mut renderer = scene_renderer(model, scene)?;
    let contexts = CheckedView::contexts(&mut renderer, context)?;
    let others = others.map_or(Ok(Vec::new()), |others| CheckedView::others(&mut renderer, &others, context))?;
    let image_size = reader.source.image_size(index, scene.context_frames[0] as usize)?;
    Ok(WrittenScene {
        stored,
        file_bytes: std::fs::metadata(&options.out).map_or(0, |file| file.len()),
        frame_names,
        num_frames: reader.source.num_frames(index)?,
        image_size,
        cropped: cropped(image_size, [scene.width, scene.height]),
        contexts,
        others,
        encoded,
    })
}

/// Writes the scene, whose tokens become those of a coded file, and returns how they are stored.
fn write(
    coder: &Coder,
    encoded: &mut EncodedScene,
    options: &SceneOptions,
    (model, reader, index): (&TrainedModel, &ClipReader, usize),
) -> Result<String, SceneError> {
    let scene = &encoded.scene;
    let (codec, step, note) = match coder {
        Coder::Plain(format) => {
            scene.write(&options.out, *format)?;
            return Ok(format.to_string());
        }
        Coder::Expected(codec, loss) => {
            (codec, expected_step(scene, codec, *loss)?, format!("expected loss {loss} dB"))
        }
        Coder::Measured(codec, loss) => {
            let (step, loss) = step_for_loss(model, reader, index, (scene, &encoded.context), codec, *loss)?;
            (codec, step, format!("measured loss {loss:.3} dB"))
        }
        Coder::Bytes(codec, bytes) => {
            let step = step_for_bytes(scene, codec, *bytes)?.0;
            (codec, step, format!("at most {:.3} kB", *bytes as f64 / 1e3))
        }
    };
    encoded.sort_tokens()?;
    encoded.scene.write_coded(&options.out, codec, step)?;
    encoded.scene.tokens = encoded.scene.rounded_tokens(codec, step)?;
    Ok(format!("coded, {note}"))
}

/// Returns the size of the central part of an image that has the proportions of the network's; `None` if little is lost.
fn cropped(image: [usize; 2], network: [usize; 2]) -> Option<[usize; 2]> {
    let of_other = |side: usize| image[1 - side] * network[side] / network[1 - side];
    let kept = [0, 1].map(|side| image[side].min(of_other(side)));
    (0..2).any(|side| kept[side] * 10 < image[side] * 9).then_some(kept)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn much_cropping_is_told() {
        assert_eq!(cropped([1080, 1920], [64, 64]), Some([1080, 1080]));
        assert_eq!(cropped([4000, 1000], [128, 64]), Some([2000, 1000]));
        assert_eq!([cropped([64, 64], [64, 64]), cropped([105, 100], [64, 64])], [None, None]);
    }
}
