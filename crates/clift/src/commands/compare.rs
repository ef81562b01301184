//! `clift compare`.

use std::path::PathBuf;

use clift_eval::{Comparison, Evaluation, MethodFilter};

use crate::commands::parse::parse_sides;
use crate::output::stdout::print_result;

/// Compares two evaluations, prints the table and writes the JSON.
pub fn run(args: &CompareArgs) -> anyhow::Result<()> {
    let (a, b) = (Evaluation::read(&args.a)?, Evaluation::read(&args.b)?);
    let comparison = Comparison::new(&a, &b, args.variants.as_ref())?;
    print_result(comparison.to_string().trim_end())?;
    if let Some(json) = &args.json {
        crate::output::json::write(&comparison, json)?;
        print_result(&format!("results: {}", json.display()))?;
    }
    Ok(())
}

/// Arguments of `clift compare`.
#[derive(Debug, clap::Args)]
pub struct CompareArgs {
    /// The first evaluation
    pub a: PathBuf,
    /// The second
    pub b: PathBuf,
    /// Compare a variant of the first with another of the second, at equal counts: kmeans,clift or clift:f32,clift:int8
    #[arg(long, value_name = "A,B", value_parser = parse_sides)]
    pub variants: Option<[MethodFilter; 2]>,
    /// Write the differences as JSON
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
}
