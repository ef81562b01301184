//! `clift export`.

use std::path::PathBuf;

use clap::ValueEnum;
use clift_model::ModelPath;
use clift_train::{Config, ExportFormat, export, read_config, require_absent};

use crate::output::stdout;

/// Arguments of `clift export`.
#[derive(Debug, clap::Args)]
pub struct ExportArgs {
    /// A model directory, a run directory, or a model.safetensors in one
    #[arg(value_name = "MODEL|RUN")]
    pub model: PathBuf,
    /// What kind of file is written
    #[arg(long, value_name = "FORMAT")]
    pub format: Format,
    /// The file to write
    #[arg(long, short, value_name = "FILE")]
    pub out: PathBuf,
}

/// Kinds of files.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Format {
    /// For torch.load
    Pytorch,
    /// The same keys in a safetensors file
    Safetensors,
}

/// Writes a model's weights for PyTorch.
pub fn run(args: &ExportArgs) -> anyhow::Result<()> {
    require_absent(&args.out)?;
    let model = ModelPath::find(&args.model)?;
    let (config, _) = read_config::<Config>(&model.dir.join("config.toml"), &[])?;
    let format = match args.format {
        Format::Pytorch => ExportFormat::Pytorch,
        Format::Safetensors => ExportFormat::Safetensors,
    };
    let exported = export(&config, &model, format, &args.out)?;
    let condenser = if exported.has_condenser { "with condenser" } else { "without condenser" };
    stdout::print_result(&format!(
        "{}: {} tensors, {} values, {} {condenser}, of {}",
        args.out.display(),
        exported.num_tensors,
        exported.num_values,
        config.model.variant,
        model.weights.display(),
    ))
}
