//! `clift encode`.

use std::path::{Path, PathBuf};

use clift_core::DVec3;
use clift_data::{ClipReader, SceneSource, Split, plural};
use clift_model::{ModelError, TokenCount, TokenKind, TrainedModel};
use clift_scene::{
    CodedLoss, EncodeOptions, EncodedScene, HeldOutFrame, Scene, TokenCodec, TokenCoding, TokenFormat,
    check_output_path, encode, expected_step, step_for_bytes, step_for_loss,
};
use serde::Serialize;

use crate::commands::args::model_args::ModelArgs;
use crate::commands::args::parse::{parse_kb, parse_loss, parse_output, parse_split};
use crate::commands::args::shared_args::ConfigArgs;
use crate::exit_code::{UsageError, usage_bail};
use crate::output::output_file::OutputFile;
use crate::output::stdout::{print_note, print_result, print_warning};
use crate::output::units::file_size;

const MAX_LISTED_KEYS: usize = 8;

#[derive(Debug, clap::Args)]
pub struct EncodeArgs {
    /// Run, model or model.safetensors; or photos, encoded with models/rooms
    ///
    /// `clift encode DIR` encodes a capture with the model that ships with clift, which is trained on synthetic scenes. The
    /// environment variable `CLIFT_MODEL` names another.
    #[arg(value_name = "RUN|MODEL|DIR")]
    pub model: PathBuf,
    /// Capture or data set in any layout [default: the data of the run]
    #[arg(value_name = "DIR")]
    pub data: Option<PathBuf>,
    /// Scene file to write
    #[arg(long, short, value_name = "FILE")]
    pub out: PathBuf,
    /// Replace existing files
    #[arg(long)]
    pub force: bool,
    /// Key of the scene, if the data set has several
    #[arg(long, value_name = "KEY")]
    pub scene: Option<String>,
    /// Split of the data set: train or test
    #[arg(long, value_name = "SPLIT", default_value = "test", value_parser = parse_split)]
    pub split: Split,
    /// Context frames by position or file name [default: spread along the path]
    ///
    /// Positions count from 0 in the order of the scene; names are those of the image files, with or without extension:
    /// `--context 0,5,9` or `--context IMG_1.jpg,IMG_7.jpg`. Numbers alone are positions, unless one begins with a zero:
    /// `0005` is a name. By default, as many as in training; of a DIR of the command line, every fourth frame, up to three
    /// times as many, if the network has camera-relative attention.
    #[arg(long, value_name = "FRAMES", value_delimiter = ',')]
    pub context: Vec<String>,
    /// Tokens to store, as a number or a share [default: 1/4; the best for --size-kb]
    #[arg(long, value_name = "COUNT")]
    pub stored_tokens: Option<TokenCount>,
    /// Format of the tokens: f32, f16, int8, coded or coded-DB [default: coded with a codec, else f16]
    ///
    /// `coded` needs the token codec of the model, which training fits (`clift codec` for other models). Its step is the
    /// one that lost 0.02 dB on training scenes, or DB with `coded-DB`.
    #[arg(long, value_name = "FORMAT", conflicts_with_all = ["quality", "size_kb"])]
    pub format: Option<TokenCoding>,
    /// Code the tokens with at most this loss of PSNR in dB, measured on this scene
    #[arg(long, value_name = "DB", value_parser = parse_loss, conflicts_with = "size_kb")]
    pub quality: Option<f64>,
    /// Code the tokens into a file of at most N kB
    ///
    /// Without --stored-tokens, the number of tokens is the one with the best expected PSNR at this size.
    #[arg(long, value_name = "N", value_parser = parse_kb)]
    pub size_kb: Option<f64>,
    /// Also write the cluster of every token, as JSON
    #[arg(long, value_name = "FILE", value_parser = parse_output)]
    pub save_clusters: Option<PathBuf>,
    #[command(flatten)]
    pub overrides: ConfigArgs,
}

/// Content of `--save-clusters`.
#[derive(Debug, Serialize)]
struct ClustersFile<'a> {
    scene: &'a str,
    /// Context frames; tokens are ordered by frame, row and column of the patch.
    frames: &'a [u32],
    rows: usize,
    columns: usize,
    /// Cluster of each token, which is the index of a token of the scene file.
    assignment: &'a [u32],
    /// Token nearest to the centre of each cluster.
    centroids: &'a [u32],
}

impl<'a> ClustersFile<'a> {
    fn of(encoded: &'a EncodedScene) -> Self {
        let EncodedScene { scene, clusters, .. } = encoded;
        let patch_size = scene.model.patch_size;
        Self {
            scene: &scene.key,
            frames: &scene.context_frames,
            rows: scene.height / patch_size,
            columns: scene.width / patch_size,
            assignment: clusters.assignment(),
            centroids: clusters.centroid_index(),
        }
    }
}

/// Encodes one scene and writes its file.
pub fn run(args: &EncodeArgs) -> anyhow::Result<()> {
    check_output_path(&args.out).map_err(|error| UsageError(error.to_string()))?;
    // `check_output_path` refuses files that are not scenes, and no input is a scene.
    OutputFile::new(&args.out, args.force, &[])?;
    let inputs: Vec<&Path> =
        [Some(&args.model), args.data.as_ref()].into_iter().flatten().map(PathBuf::as_path).collect();
    let clusters = args.save_clusters.as_ref().map(|path| OutputFile::new(path, args.force, &inputs)).transpose()?;
    if args.save_clusters.as_ref() == Some(&args.out) {
        usage_bail!("--save-clusters and -o name one file, {}; choose another name", args.out.display());
    }
    let model_args = ModelArgs::find(&args.model, args.data.as_deref(), &args.overrides)?;
    let ModelArgs { given, path, config, .. } = &model_args;
    let supports_clusters = config.model.architecture.supports_clusters();
    if !supports_clusters && args.save_clusters.is_some() {
        usage_bail!("--save-clusters: the tokens of {} are not clustered; leave the option out", given.display());
    }
    let source = model_args.open_data(args.split)?.source;
    let scene = find_scene(source.as_ref(), args.scene.as_deref())?;
    let names = source.frame_names(scene)?;
    let context = frame_positions(&args.context, &names)?;
    let reader = ClipReader { source, options: config.data.clip_options() };
    let options = EncodeOptions {
        context: (!args.context.is_empty()).then_some(context),
        num_context: model_args.num_context(reader.source.as_ref(), scene)?,
        stored_tokens: TokenCount::Share(if supports_clusters { 0.25 } else { 1.0 }),
        grouping: config.clusters.grouping,
        kmeans: config.clusters.kmeans.clone(),
        seed: config.seed,
        model_path: Scene::model_path_for(given, &args.out),
    };
    let model = model_args.open()?;
    let coding = Coding::new(args, &path.weights, &model)?;
    let stored_tokens = coding.stored_tokens(args, &options, &reader);
    let mut encoded = encode(&model, &reader, scene, &EncodeOptions { stored_tokens, ..options })?;
    let written = coding.write(&mut encoded, args, (&model, &reader, scene))?;
    if let Some(file) = clusters {
        file.write_json(&ClustersFile::of(&encoded))?;
    }
    print_result(&describe(&encoded, &written, &args.out, &names))?;
    warn_of_turn(&encoded.scene);
    let photo = reader.source.image_size(scene, encoded.scene.context_frames[0] as usize)?;
    if let Some([width, height]) = cropped(photo, [encoded.scene.width, encoded.scene.height]) {
        print_note(&format!(
            "of images of {} x {}, the central {width} x {height} pixels are used",
            photo[0], photo[1]
        ));
    }
    print_check(HeldOutFrame::render(&model, &reader, scene, &encoded.scene)?, given, &names)
}

/// Returns the file name of a frame, or its position if it has no file.
fn frame_name(names: &[String], frame: usize) -> String {
    names.get(frame).cloned().unwrap_or_else(|| frame.to_string())
}

/// Angle between two context views, in degrees, above which `models/rooms` renders noise
/// (models/rooms/README.md, "Limits").
const MAX_TURN_DEG: f64 = 140.0;

/// Warns of context views that look at a place from opposite sides.
fn warn_of_turn(scene: &Scene) {
    let axes: Vec<DVec3> = scene.context.iter().map(|camera| camera.c2w.rotation.z_axis).collect();
    let least = axes.iter().flat_map(|a| axes.iter().map(|b| a.dot(*b))).fold(1.0, f64::min);
    let widest = least.max(-1.0).acos().to_degrees();
    if widest > MAX_TURN_DEG {
        print_warning(format!(
            "context views differ in direction by up to {widest:.0} degrees; models that were trained on one side of a \
             place, such as models/rooms, render noise there: choose views of one side with --context"
        ));
    }
}

/// Returns the size of the central part of an image that has the proportions of the network's; `None` if little is lost.
fn cropped(image: [usize; 2], network: [usize; 2]) -> Option<[usize; 2]> {
    let of_other = |side: usize| image[1 - side] * network[side] / network[1 - side];
    let kept = [0, 1].map(|side| image[side].min(of_other(side)));
    (0..2).any(|side| kept[side] * 10 < image[side] * 9).then_some(kept)
}

/// Prints how a frame that is no context is rendered, with a warning if a copy of a context view is nearer to it.
fn print_check(check: Option<HeldOutFrame>, model: &Path, names: &[String]) -> anyhow::Result<()> {
    let Some(HeldOutFrame { frame, psnr, nearest_psnr }) = check else {
        return print_result("check: no frame beside the contexts to compare a rendering with");
    };
    let frame = frame_name(names, frame);
    print_result(&format!(
        "check: frame {frame}, not a context: {psnr:.2} dB rendered, {nearest_psnr:.2} dB copied from the nearest context"
    ))?;
    if psnr < nearest_psnr {
        print_warning(format!(
            "the rendering of frame {frame} is worse than a copy of the nearest context view; the scene differs \
             from the training scenes of {}, few tokens are stored, or the run is not trained enough",
            model.display()
        ));
    }
    Ok(())
}

/// Returns the positions of frames that are given by position or file name. Numbers alone are positions, unless one has
/// leading zeros, as names of images have.
fn frame_positions(frames: &[String], names: &[String]) -> anyhow::Result<Vec<usize>> {
    let frames: Vec<&str> = frames.iter().map(|frame| frame.trim()).collect();
    let is_padded = |frame: &str| frame.len() > 1 && frame.starts_with('0');
    if !frames.iter().any(|frame| is_padded(frame))
        && let Ok(positions) = frames.iter().map(|frame| frame.parse()).collect()
    {
        return Ok(positions);
    }
    let position = |&frame: &&str| {
        let has_stem = |name: &String| name.rsplit_once('.').is_some_and(|(stem, _)| stem == frame);
        let named = names.iter().position(|name| name == frame).or_else(|| names.iter().position(has_stem));
        let number = || if is_padded(frame) { None } else { frame.parse().ok() };
        let Some(position) = named.or_else(number) else {
            let first = names.iter().take(MAX_LISTED_KEYS).map(String::as_str).collect::<Vec<_>>().join(", ");
            match names.len() {
                0 => usage_bail!("--context {frame}: the frames of this data set have no file names; write positions"),
                count => usage_bail!("--context: no frame {frame}; the {count} frames start with {first}"),
            }
        };
        Ok(position)
    };
    frames.iter().map(position).collect()
}

/// How the tokens are stored.
enum Coding {
    Plain(TokenFormat),
    /// Coded with at most this loss in dB by the rates of the model.
    Expected(TokenCodec, f64),
    /// Coded with at most this loss in dB, measured on the scene.
    Measured(TokenCodec, f64),
    /// Coded into at most this number of bytes.
    Bytes(TokenCodec, u64),
}

impl Coding {
    fn new(args: &EncodeArgs, weights: &Path, model: &TrainedModel) -> anyhow::Result<Self> {
        let is_coded = matches!(args.format, Some(TokenCoding::Coded(_)));
        let architecture = model.config.architecture;
        let is_coded = is_coded || args.quality.is_some() || args.size_kb.is_some();
        if is_coded && !architecture.supports_clusters() {
            usage_bail!("the tokens of {architecture} have no codec; store them with --format f32, f16 or int8");
        }
        let found = || TokenCodec::beside(weights, model);
        let codec = || found()?.ok_or_else(|| ModelError::NoCodec { path: TokenCodec::path_of(weights) });
        Ok(match (args.quality, args.size_kb, args.format) {
            (Some(loss), ..) => Self::Measured(codec()?, loss),
            (_, Some(kb), _) => Self::Bytes(codec()?, (kb * 1e3) as u64),
            (.., Some(TokenCoding::Plain(format))) => Self::Plain(format),
            (.., Some(TokenCoding::Coded(loss))) => Self::Expected(codec()?, loss.db()),
            (.., None) => match found()? {
                Some(codec) => Self::Expected(codec, CodedLoss::default().db()),
                None => Self::Plain(TokenFormat::F16),
            },
        })
    }

    /// Returns the number of stored tokens: with a size, the number of the best expected PSNR.
    fn stored_tokens(&self, args: &EncodeArgs, options: &EncodeOptions, reader: &ClipReader) -> TokenCount {
        let Self::Bytes(codec, bytes) = self else { return args.stored_tokens.unwrap_or(options.stored_tokens) };
        let views = options.context.as_ref().map_or(options.num_context, Vec::len);
        let (height, width) = (reader.options.height, reader.options.width);
        let num_patches = codec.model.num_patches(views, height, width).unwrap_or(1);
        let tokens = *bytes as f64 - coded_overhead(views, options.model_path.len()) as f64;
        let best = TokenCount::Share(codec.rates.share_for_bytes(num_patches, tokens.max(1.0)));
        args.stored_tokens.unwrap_or(best)
    }

    /// Writes the scene, whose tokens become those of the file.
    fn write(
        self,
        encoded: &mut EncodedScene,
        args: &EncodeArgs,
        (model, reader, index): (&TrainedModel, &ClipReader, usize),
    ) -> anyhow::Result<String> {
        let (codec, step, note) = match self {
            Self::Plain(format) => {
                encoded.scene.write(&args.out, format)?;
                return Ok(format.to_string());
            }
            Self::Expected(codec, loss) => {
                let step = expected_step(&encoded.scene, &codec, loss)?;
                (codec, step, format!("expected loss {loss} dB"))
            }
            Self::Measured(codec, loss) => {
                let (step, loss) = step_for_loss(model, reader, index, (&encoded.scene, &codec), loss)?;
                (codec, step, format!("measured loss {loss:.3} dB"))
            }
            Self::Bytes(codec, bytes) => {
                let step = step_for_bytes(&encoded.scene, &codec, bytes)?.0;
                (codec, step, format!("at most {:.3} kB", bytes as f64 / 1e3))
            }
        };
        encoded.sort_tokens()?;
        encoded.scene.write_coded(&args.out, &codec, step)?;
        encoded.scene.tokens = encoded.scene.rounded_tokens(&codec, step)?;
        Ok(format!("coded, {note}"))
    }
}

/// Bytes of a coded file besides its tokens, about: header, normalization, and the views.
fn coded_overhead(num_views: usize, path_len: usize) -> usize {
    400 + path_len + 68 * num_views
}

fn describe(encoded: &EncodedScene, stored: &str, path: &Path, names: &[String]) -> String {
    let EncodedScene { scene, num_lift_tokens, cluster_error, .. } = encoded;
    let num_tokens = scene.num_tokens();
    let frames = scene.context_frames.iter().map(|&frame| frame_name(names, frame as usize));
    let frames = frames.collect::<Vec<_>>().join(", ");
    let clusters = match scene.kind {
        TokenKind::All => String::new(),
        _ => format!("\ntokens  variance within clusters\n{num_tokens:>6}  {cluster_error:.4}"),
    };
    format!(
        "{}: {num_tokens} of {num_lift_tokens} tokens ({}, {stored}), {}\nscene {}, {} of {} x {}: frames {frames}{clusters}",
        path.display(),
        scene.kind,
        file_size(std::fs::metadata(path).map_or(0, |file| file.len())),
        scene.key,
        plural(scene.context.len(), "view"),
        scene.width,
        scene.height,
    )
}

/// Returns the index of the scene with this key, or of the only scene.
fn find_scene(source: &dyn SceneSource, key: Option<&str>) -> anyhow::Result<usize> {
    let num_scenes = source.num_scenes();
    let mut keys: Vec<&str> = (0..num_scenes.min(MAX_LISTED_KEYS)).map(|scene| source.key(scene)).collect();
    if num_scenes > MAX_LISTED_KEYS {
        keys.push("..");
    }
    let keys = keys.join(", ");
    match (key, key.and_then(|key| source.find(key))) {
        (_, Some(scene)) => Ok(scene),
        (Some(key), None) => usage_bail!("no scene {key}; the {num_scenes} scenes are: {keys}"),
        (None, None) if num_scenes == 1 => Ok(0),
        (None, None) => usage_bail!("{num_scenes} scenes; choose one with --scene: {keys}"),
    }
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

    #[test]
    fn context_frames_are_positions_or_file_names() {
        let positions = |frames: &[&str]| {
            let frames: Vec<String> = frames.iter().map(ToString::to_string).collect();
            let names = ["a.jpg", "b.v2.png", "7.png", "0", "003.jpg"].map(String::from);
            frame_positions(&frames, &names).map_err(|error| error.to_string())
        };
        assert_eq!(positions(&["7", "0"]).unwrap(), [7, 0], "numbers alone are positions");
        assert_eq!(positions(&["003", " 1"]).unwrap(), [4, 1], "with leading zeros, names");
        let message = positions(&["003", "001"]).unwrap_err();
        assert!(message.starts_with("--context: no frame 001; the 5 frames"), "{message}");
        assert_eq!(positions(&["b.v2.png", "a", "7.png", "2"]).unwrap(), [1, 0, 2, 2]);
        assert_eq!(
            positions(&["a.jpg", "c.jpg"]).unwrap_err(),
            "--context: no frame c.jpg; the 5 frames start with a.jpg, b.v2.png, 7.png, 0, 003.jpg"
        );
        let message = frame_positions(&["a.jpg".into()], &[]).unwrap_err().to_string();
        assert!(message.contains("write positions"), "{message}");
    }
}
