//! `clift export`.

use std::path::PathBuf;

use clift_model::ModelPath;
use clift_train::{Config, export_f16, read_config, require_absent};

use crate::output::stdout::print_result;

#[derive(Debug, clap::Args)]
pub struct ExportArgs {
    /// Model directory, run directory, or model.safetensors in one of them
    #[arg(value_name = "MODEL|RUN")]
    pub model: PathBuf,
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
