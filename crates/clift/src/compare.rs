//! `clift compare`.

use clift_eval::{Comparison, Evaluation};

use crate::args::CompareArgs;
use crate::terminal::print_result;

/// Compares two evaluations, prints the table and writes the JSON.
pub fn run(args: &CompareArgs) -> anyhow::Result<()> {
    let (a, b) = (Evaluation::read(&args.a)?, Evaluation::read(&args.b)?);
    let comparison = Comparison::new(&a, &b, args.variants.as_ref())?;
    print_result(comparison.to_string().trim_end())?;
    if let Some(json) = &args.json {
        crate::json::write(&comparison, json)?;
        print_result(&format!("results: {}", json.display()))?;
    }
    Ok(())
}
