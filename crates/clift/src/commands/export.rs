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
    /// Format of the file: pytorch (for torch.load) or safetensors
    #[arg(long, value_name = "FORMAT", value_parser = parse_format)]
    pub format: ExportFormat,
    /// File to write
    #[arg(long, short, value_name = "FILE")]
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
