//! `clift export`.

use std::path::PathBuf;

use clap::builder::PossibleValuesParser;
use clift_model::ModelPath;
use clift_train::{Config, export_f16, read_config, require_absent};

use crate::output::stdout::print_result;

#[derive(Debug, clap::Args)]
pub struct ExportArgs {
    /// Model directory, run directory, or model.safetensors in one of them
    #[arg(value_name = "MODEL|RUN")]
    pub model: PathBuf,
    /// Format: f16, a model directory with the weights rounded to f16; fit its token codec with `clift codec`
    #[arg(long, value_name = "FORMAT", value_parser = PossibleValuesParser::new(["f16"]))]
    pub format: String,
    /// Model directory to write
    #[arg(long, short, value_name = "DIR")]
    pub out: PathBuf,
}

pub fn run(args: &ExportArgs) -> anyhow::Result<()> {
    require_absent(&args.out)?;
    let model = ModelPath::find(&args.model)?;
    let (config, _) = read_config::<Config>(&model.dir.join("config.toml"), &[])?;
    let num_values = export_f16(&config, &model, &args.out)?;
    print_result(&format!("{}: {num_values} values in f16, from {}", args.out.display(), model.weights.display()))
}
