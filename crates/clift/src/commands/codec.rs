//! `clift codec`.

use std::path::PathBuf;

use anyhow::Context;
use clift_core::plural;
use clift_data::{ClipReader, Split};
use clift_eval::{EvalFrames, EvalSplit};
use clift_scene::TokenCodec;
use clift_train::{fit_token_codec, lock_run};

use crate::commands::args::model_args::ModelArgs;
use crate::commands::args::parse::parse_split;
use crate::commands::args::shared_args::ConfigArgs;
use crate::interrupt::{self, Ending};
use crate::output::output_file::OutputFile;
use crate::output::progress::progress_sink;
use crate::output::stdout::print_result;

#[derive(Debug, clap::Args)]
pub struct CodecArgs {
    /// Run or model directory, or model.safetensors in one of them
    #[arg(value_name = "RUN|MODEL")]
    pub model: PathBuf,
    /// Training scenes in any layout [default: the data of the run]
    #[arg(value_name = "DIR")]
    pub data: Option<PathBuf>,
    /// Split of the data set: train or test
    #[arg(long, value_name = "SPLIT", default_value = "train", value_parser = parse_split)]
    pub split: Split,
    /// Replace an existing codec; scenes coded with it become unreadable
    #[arg(long)]
    pub force: bool,
    #[command(flatten)]
    pub overrides: ConfigArgs,
}

/// Fits the codec of a model.
pub fn run(args: &CodecArgs) -> anyhow::Result<()> {
    let mut sink = progress_sink();
    // A run in training writes its codec itself.
    let _lock = lock_run(&args.model, sink.as_mut())?;
    let model_args = ModelArgs::new(&args.model, args.data.as_deref(), &args.overrides)?;
    let ModelArgs { path, config, .. } = &model_args;
    let out = TokenCodec::path_of(&path.weights);
    OutputFile::new(&out, args.force, &[]).context("scenes coded with the codec need it")?;
    let opened = model_args.open_data(args.split)?;
    // Also of a DIR, which may be the capture that the run was trained on.
    let hold_out = if opened.shares_scenes { config.data.hold_out } else { 0 };
    let reader = ClipReader { source: opened.source, options: config.data.clip_options() };
    let model = model_args.open()?;
    let frames = EvalFrames { split: EvalSplit::Train, hold_out };
    let stop = interrupt::flag(Ending::WITHOUT_RESULTS)?;
    let num_scenes = fit_token_codec(config, (&model, &path.weights), (&reader, frames), &stop, sink.as_mut())?;
    drop(sink);
    print_result(&format!("{}: fitted on {}", out.display(), plural(num_scenes, "scene")))
}
