//! `clift compare`.

use std::path::PathBuf;

use clift_eval::{Comparison, Evaluation, MethodFilter};

use crate::commands::args::parse::{parse_input, parse_methods};
use crate::commands::args::shared_args::JsonArg;
use crate::output::stdout::print_result;

pub fn run(args: &CompareArgs) -> anyhow::Result<()> {
    let json = args.json.open(&[&args.a, &args.b])?;
    let (a, b) = (Evaluation::read(&args.a)?, Evaluation::read(&args.b)?);
    let comparison = Comparison::new(&a, &b, args.methods.as_ref())?;
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
    /// Compare method A of the first with method B of the second, at equal counts
    #[arg(long, value_name = "A,B", value_parser = parse_methods)]
    pub methods: Option<[MethodFilter; 2]>,
    #[command(flatten)]
    pub json: JsonArg,
}
