//! `clift export`.

use std::path::PathBuf;

use clift_model::ModelPath;
use clift_train::{Config, ExportFormat, export, read_config, require_absent};

use crate::commands::args::parse::parse_format;
use crate::output::stdout::print_result;

#[derive(Debug, clap::Args)]
pub struct ExportArgs {
    /// Model directory, run directory, or model.safetensors in one of them
    #[arg(value_name = "MODEL|RUN")]
    pub model: PathBuf,
    /// Format: pytorch (for torch.load), safetensors, or f16
    ///
    /// The first two have the names of published checkpoints. `f16` writes a model directory with the weights rounded to
    /// f16, which every command reads; fit its token codec with `clift codec`.
    #[arg(long, value_name = "FORMAT", value_parser = parse_format)]
    pub format: ExportFormat,
    /// File to write; a directory for f16
    #[arg(long, short, value_name = "FILE|DIR")]
    pub out: PathBuf,
}

pub fn run(args: &ExportArgs) -> anyhow::Result<()> {
    require_absent(&args.out)?;
    let model = ModelPath::find(&args.model)?;
    let (config, _) = read_config::<Config>(&model.dir.join("config.toml"), &[])?;
    let exported = export(&config, &model, args.format, &args.out)?;
    let condenser = if exported.has_condenser { "with condenser" } else { "without condenser" };
    print_result(&format!(
        "{}: {} tensors, {} values, {} {condenser}, from {}",
        args.out.display(),
        exported.num_tensors,
        exported.num_values,
        config.model.variant,
        model.weights.display(),
    ))
}
