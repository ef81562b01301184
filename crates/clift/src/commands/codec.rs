//! `clift codec`.

use std::path::PathBuf;

use clift_data::{ClipReader, SourceKind, Split, open_dataset};
use clift_eval::{EvalFrames, EvalSplit, FittedCodec};
use clift_model::{ModelPath, TokenCodec, TrainedModel};
use clift_train::fit_token_codec;

use crate::commands::encode::open_folder;
use crate::commands::parse::parse_split;
use crate::commands::shared_args::{ConfigArgs, read_config};
use crate::exit_code::usage_bail;
use crate::interrupt;
use crate::output::bar::progress_sink;
use crate::output::stdout::print_result;
use crate::output::table::table;

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

/// Fits the codec of a model and prints its rates.
pub fn run(args: &CodecArgs) -> anyhow::Result<()> {
    let path = ModelPath::find(&args.model)?;
    let out = TokenCodec::path_of(&path.weights);
    if !args.force && out.exists() {
        usage_bail!("the codec {} exists; scenes coded with it need it; replace it with --force", out.display());
    }
    let (mut config, overrides) = read_config(&path.dir.join("config.toml"), &args.overrides.set, |_| Ok(()))?;
    if config.model != path.config()? {
        usage_bail!("--set model: the weights were trained with another network; remove the override");
    }
    config.device = args.overrides.device.unwrap_or(config.device);
    if args.data.is_some() {
        config.data.source = SourceKind::Auto;
        config.data.root.clone_from(&args.data);
    }
    config.validate()?;
    let (source, hold_out) = if let Some(folder) = &args.data {
        (open_folder(folder, args.split, &config, &overrides)?, 0)
    } else {
        let opened = open_dataset(&config.data, args.split)?;
        let hold_out = if opened.shares_scenes { config.data.hold_out } else { 0 };
        (opened.source, hold_out)
    };
    let reader = ClipReader { source, options: config.data.clip_options() };
    let model = TrainedModel::open(&path, &config.model, &config.device.open()?)?;
    let frames = EvalFrames { split: EvalSplit::Train, hold_out };
    let mut sink = progress_sink();
    let stop = interrupt::flag()?;
    let fitted = fit_token_codec(&config, (&model, &path.weights), (&reader, frames), &stop, sink.as_mut())?;
    drop(sink);
    print_result(&describe(&fitted, &out.display().to_string()))
}

/// Returns the rates by count and step, and the bits beside the entropy.
fn describe(fitted: &FittedCodec, path: &str) -> String {
    let FittedCodec { codec, stream_and_entropy_bits, num_values, num_scenes } = fitted;
    let (rates, dim) = (&codec.rates, codec.model.dim as f64);
    let header = ["share of tokens", "step", "bits a value", "loss, dB", "PSNR, dB"];
    let rows = rates.shares.iter().enumerate().flat_map(|(c, share)| {
        rates.steps.iter().enumerate().map(move |(k, step)| {
            let at = c * rates.steps.len() + k;
            [
                format!("{share:.4}"),
                format!("{step:.4}"),
                format!("{:.3}", rates.bits[at] / dim),
                format!("{:.4}", rates.loss[at]),
                format!("{:.2}", rates.psnr[c] - rates.loss[at]),
            ]
        })
    });
    let bounds = rates.steps.iter().zip(stream_and_entropy_bits).map(|(step, [stream, entropy])| {
        let [stream, entropy] = [stream, entropy].map(|bits| bits / (*num_values).max(1) as f64);
        let above = format!("{:+.2} %", 100.0 * (stream / entropy - 1.0));
        [format!("{step:.4}"), format!("{stream:.4}"), format!("{entropy:.4}"), above]
    });
    format!(
        "{path}: fitted on {num_scenes} scenes, {num_values} values measured\n{}\n\nbits a value of the streams, and the \
         entropy of the levels by direction\n{}",
        table(header, rows),
        table(["step", "stream", "entropy", "above"], bounds),
    )
}
