//! `clift compare`.

use std::path::PathBuf;

use clift_eval::{Comparison, Evaluation};

use crate::commands::args::parse::parse_input;
use crate::commands::args::shared_args::JsonArg;
use crate::output::stdout::print_result;

pub fn run(args: &CompareArgs) -> anyhow::Result<()> {
    let json = args.json.open(&[&args.a, &args.b])?;
    let (a, b) = (Evaluation::read(&args.a)?, Evaluation::read(&args.b)?);
    let comparison = Comparison::new(&a, &b)?;
    print_result(comparison.to_string().trim_end())?;
    json.write(&comparison)
}

#[derive(Debug, clap::Args)]
pub struct CompareArgs {
    /// First evaluation: a run, the folder of an evaluation or its views.csv
    #[arg(value_parser = parse_input)]
    pub a: PathBuf,
    /// Second evaluation
    #[arg(value_parser = parse_input)]
    pub b: PathBuf,
    #[command(flatten)]
    pub json: JsonArg,
}
