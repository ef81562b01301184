//! `clift encode`.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use clift_data::{
    ClipReader, DatasetRoot, FileOptions, OpenedSource, SAME_SCENES, SceneSource, SourceKind, SourceOptions, Split,
    open_dataset, open_source,
};
use clift_eval::{EncodeOptions, EncodedScene, encode};
use clift_model::{DeviceName, ModelPath, TokenCount, TokenFormat, TrainedModel, check_output_path};
use clift_train::{Config, Override, read_config};

use crate::commands::data::text::{bytes, count};
use crate::exit_code::UsageError;
use crate::output::stdout;

/// Keys that are shown when one has to be chosen.
const MAX_KEYS_SHOWN: usize = 8;

/// Arguments of `clift encode`.
#[derive(Debug, clap::Args)]
pub struct EncodeArgs {
    /// A run or model directory, or a model.safetensors in one
    #[arg(value_name = "RUN|MODEL")]
    pub model: PathBuf,
    /// A capture (a folder with transforms.json or a COLMAP model), or a data set in any layout; the run's own data by
    /// default
    #[arg(value_name = "DIR")]
    pub data: Option<PathBuf>,
    /// The scene file to write
    #[arg(long, short, value_name = "FILE")]
    pub out: PathBuf,
    /// Key of the scene, where there are several
    #[arg(long, value_name = "KEY")]
    pub scene: Option<String>,
    /// Half of the data: train or test
    #[arg(long, value_name = "SPLIT", default_value = "test", value_parser = parse_split)]
    pub split: Split,
    /// Frames the encoder sees, as 0,5,9; by default as many as in training, spread along the path
    #[arg(long, value_name = "FRAMES", value_delimiter = ',')]
    pub context: Vec<usize>,
    /// Tokens to keep, a number or a share
    #[arg(long, value_name = "COUNT", default_value = "1/4")]
    pub storage: TokenCount,
    /// Number format of the tokens in the file: f32, f16 or int8
    #[arg(long, value_name = "FORMAT", default_value_t)]
    pub tokens: TokenFormat,
    /// Change a key of the run's config: `--set 'data.root="PATH"'`
    #[arg(long, value_name = "KEY=TOML")]
    pub set: Vec<String>,
    /// Where tensors live: flex, ndarray or wgpu
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<DeviceName>,
}

/// Encodes one scene and writes its file.
pub fn run(args: &EncodeArgs) -> anyhow::Result<()> {
    check_output_path(&args.out).map_err(|error| UsageError(error.to_string()))?;
    let model = ModelPath::find(&args.model)?;
    let (mut config, overrides) = read_config::<Config>(&model.dir.join("config.toml"), &args.set)?;
    // No shape shows heads: another number would be encoded, and drawn, without a word.
    if config.model != model.config()? {
        return Err(
            UsageError("--set model: the network is what the weights were trained with: leave it out".into()).into()
        );
    }
    for change in &overrides {
        stdout::print_note(&change.to_string());
    }
    config.device = args.device.unwrap_or(config.device);
    // A model that was imported names no data.
    if args.data.is_some() {
        config.data.source = SourceKind::Auto;
        config.data.root.clone_from(&args.data);
    }
    config.validate()?;
    let source = match &args.data {
        Some(folder) => open_folder(folder, args.split, &config, &overrides)?,
        None => open_dataset(&config.data, args.split)?.source,
    };
    let scene = choose(source.as_ref(), args.scene.as_deref())?;
    let reader = ClipReader { source, options: config.data.clip_options() };
    let options = EncodeOptions {
        context: (!args.context.is_empty()).then(|| args.context.clone()),
        num_context: config.data.views.max_context,
        storage: args.storage,
        grouping: config.clusters.grouping,
        kmeans: config.clusters.kmeans.clone(),
        seed: config.seed,
        model_path: args.model.to_string_lossy().into_owned(),
    };
    let model = TrainedModel::open(&model, &config.model, &config.device.open()?)?;
    let encoded = encode(&model, &reader, scene, &options)?;
    encoded.scene.write(&args.out, args.tokens)?;
    stdout::print_result(&told(&encoded, args.tokens, &args.out))
}

/// What was written, for people.
fn told(encoded: &EncodedScene, storage: TokenFormat, path: &Path) -> String {
    let EncodedScene { scene, num_lift_tokens, cluster_error } = encoded;
    let num_tokens = scene.num_tokens();
    let frames = scene.context_frames.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ");
    format!(
        "{}: {num_tokens} of {num_lift_tokens} tokens ({}, {storage}), {}\nscene {}, {} of {} x {}: frames {frames}\n\
         tokens  variance left within clusters\n{num_tokens:>6}  {cluster_error:.4}",
        path.display(),
        scene.kind,
        bytes(scene.file_bytes(storage)),
        scene.key,
        count(scene.context.len(), "view"),
        scene.width,
        scene.height,
    )
}

/// Opens a folder of scenes in any layout, or a single scene, with the options of the run's files only where `--set` gave
/// them for this one.
fn open_folder(
    folder: &Path,
    split: Split,
    config: &Config,
    overrides: &[Override],
) -> anyhow::Result<Arc<dyn SceneSource>> {
    let is_meant = overrides.iter().any(|change| change.key.starts_with("data.files"));
    let files = if is_meant { config.data.files.clone() } else { FileOptions::default() };
    // Filters choose what to train on; this scene was chosen by hand.
    let options = SourceOptions { files, ..SourceOptions::default() };
    let OpenedSource { source, report: mut ledger, .. } = open_source(&DatasetRoot::find(folder)?, split, &options)?;
    ledger.notes.retain(|note| note != SAME_SCENES);
    if ledger.has_content() {
        stdout::print_note(&format!("{}: {ledger}", folder.display()));
    }
    Ok(source)
}

/// The scene asked for, or the only one.
fn choose(source: &dyn SceneSource, key: Option<&str>) -> anyhow::Result<usize> {
    let num_scenes = source.num_scenes();
    let mut keys: Vec<&str> = (0..num_scenes.min(MAX_KEYS_SHOWN)).map(|scene| source.key(scene)).collect();
    if num_scenes > MAX_KEYS_SHOWN {
        keys.push("..");
    }
    let keys = keys.join(", ");
    match key {
        Some(key) => match source.find(key) {
            Some(scene) => Ok(scene),
            None => Err(UsageError(format!("there is no scene {key}; the {num_scenes} there are: {keys}")).into()),
        },
        None if num_scenes == 1 => Ok(0),
        None => Err(UsageError(format!("{num_scenes} scenes; choose one with --scene: {keys}")).into()),
    }
}

fn parse_split(text: &str) -> Result<Split, String> {
    let splits = [Split::Train, Split::Test];
    splits.into_iter().find(|split| split.to_string() == text).ok_or_else(|| "write train or test".into())
}
