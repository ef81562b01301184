//! `clift encode`.

use std::path::PathBuf;
use std::sync::Arc;

use clift_data::{ClipReader, SceneSource, SceneSubset, Split};
use clift_model::{Precision, TokenCount};
use clift_scene::{
    ContextChoice, EncodeOptions, Scene, SceneError, SceneOptions, TokenCoding, check_output_path, encode_scene,
    find_scene, frame_positions,
};

use crate::commands::args::model_args::ModelArgs;
use crate::commands::args::parse::{parse_hold_out, parse_split};
use crate::commands::args::shared_args::ConfigArgs;
use crate::exit_code::UsageError;
use crate::output::counter::Counter;
use crate::output::output_file::OutputFile;
use crate::output::stdout::{print_note, print_warning};
use crate::output::written_scene::print_scene;

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
    /// Context frames by position or file name, encoded together [default: groups of neighbours]
    ///
    /// Positions count from 0 in the order of the scene; names are those of the image files, with or without extension:
    /// `--context 0,5,9` or `--context IMG_1.jpg,IMG_7.jpg`. Numbers alone are positions, unless one begins with a zero:
    /// `0005` is a name. By default, a DIR of the command line is encoded in groups of neighbours, as many views each as in
    /// training, that together contain every photo (up to 128); a view is rendered from the groups nearest to it. A scene of
    /// the run's data, or of a network with learned tokens, has one group along the camera path.
    #[arg(long, value_name = "FRAMES", value_delimiter = ',', conflicts_with = "near")]
    pub context: Vec<String>,
    /// Encode this frame and those nearest to it, as one group
    #[arg(long, value_name = "FRAME")]
    pub near: Option<String>,
    /// Leave one of N photos out, and compare it with its rendering
    #[arg(long, value_name = "N", default_value_t = 0, hide_default_value = true, value_parser = parse_hold_out)]
    pub hold_out: usize,
    /// Tokens to store, as a number or a share [default: 1/4, of several groups 1/2]
    ///
    /// Of many groups the default falls to 1/8. A number below 32 tokens a group makes fewer groups, which leave photos out.
    #[arg(long, value_name = "COUNT")]
    pub stored_tokens: Option<TokenCount>,
    /// Format of the tokens: f32, f16, coded or coded-DB [default: coded with a codec, else f16]
    ///
    /// `coded` needs the token codec of the model, which training fits (`clift codec` for other models). Its step is the
    /// one that lost 0.02 dB on training scenes, or DB with `coded-DB`.
    #[arg(long, value_name = "FORMAT")]
    pub format: Option<TokenCoding>,
    /// Fit the tokens to the photos of a capture, in this many steps, such as 30
    ///
    /// Gradient descent through the renderer, for every group of neighbours: views between the photos are nearer to the truth,
    /// in about twelve times the time.
    #[arg(long, value_name = "STEPS", default_value_t = 0, hide_default_value = true)]
    pub refine: usize,
    /// Operands of matrix products: f32, bf16 or f16 [default: bf16 if the CPU has its instructions, else f32]
    #[arg(long, value_name = "PRECISION")]
    pub precision: Option<Precision>,
    #[command(flatten)]
    pub overrides: ConfigArgs,
}

impl EncodeArgs {
    /// Returns the context views; `names` are those of all frames.
    fn contexts(&self, model: &ModelArgs, names: &[String]) -> Result<ContextChoice, SceneError> {
        let num_views = model.config.data.views.max_context;
        if let Some(frame) = &self.near {
            let frame = frame_positions(std::slice::from_ref(frame), names)?[0];
            return Ok(ContextChoice::Near { frame, num_views });
        }
        if self.context.is_empty() {
            return Ok(model.context());
        }
        Ok(ContextChoice::Frames(frame_positions(&self.context, names)?))
    }
}

/// Returns a scene without its damaged frames, which are named, and its number.
fn readable_scene(source: Arc<dyn SceneSource>, key: Option<&str>) -> anyhow::Result<(Arc<dyn SceneSource>, usize)> {
    let scene = find_scene(source.as_ref(), key)?;
    let names = source.frame_names(scene)?;
    let (readable, bad) = SceneSubset::readable(source, scene)?;
    for (frame, error) in bad {
        let name = names.get(frame).map_or_else(|| format!("frame {frame}"), Clone::clone);
        print_note(&format!("skipped {name}: {error}"));
    }
    Ok((Arc::new(readable), 0))
}

/// Encodes one scene and writes its file.
pub fn run(args: &EncodeArgs) -> anyhow::Result<()> {
    check_output_path(&args.out).map_err(|error| UsageError(error.to_string()))?;
    // `check_output_path` refuses files that are not scenes, and no input is a scene.
    OutputFile::new(&args.out, args.force, &[])?;
    let model_args = ModelArgs::find(&args.model, args.data.as_deref(), &args.overrides)?;
    let ModelArgs { given, path, config, .. } = &model_args;
    let source = model_args.open_data(args.split)?.source;
    let (source, scene) = readable_scene(source, args.scene.as_deref())?;
    let encode = EncodeOptions {
        context: args.contexts(&model_args, &source.frame_names(scene)?)?,
        hold_out: args.hold_out,
        stored_tokens: args.stored_tokens,
        grouping: config.clusters.grouping,
        kmeans: config.clusters.kmeans.clone(),
        seed: config.seed,
        model_path: Scene::model_path_for(given, &args.out),
    };
    let (weights, out) = (path.weights.clone(), args.out.clone());
    let options = SceneOptions { encode, refine_steps: args.refine, coding: args.format, weights, out };
    let options_of_views = model_args.clip_options(source.as_ref(), scene)?;
    let reader = ClipReader { source, options: options_of_views };
    let mut counter = None;
    let mut progress = |done: usize, total: usize| {
        counter.get_or_insert_with(|| Counter::new("groups fitted", total as u64)).set(done as u64);
    };
    let model = model_args.open()?;
    let precision = args.precision.unwrap_or_else(|| Precision::for_images(&model.device));
    precision.check("--precision", &model.device)?;
    let _precision = precision.scope();
    let written = encode_scene(&model, &reader, scene, &options, &mut progress)?;
    if args.refine > 0 && counter.is_none() {
        print_warning("--refine: the scene is one group of views, whose tokens are not fitted");
    }
    drop(counter);
    // Contexts of a run's own data show how well it is trained, not how far apart they are.
    print_scene(&written, &args.out, &given.display().to_string(), model_args.folder.is_some())
}
