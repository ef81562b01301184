//! `clift flops`.

use std::path::PathBuf;

use clift_model::{FlopConvention, Macs, ModelConfig, TokenCount};
use clift_train::{Config, read_config};
use serde::Serialize;

use crate::output::stdout::{print_note, print_result};
use crate::output::table;

/// Rendered tokens of the paper's table.
const PAPER_TOKENS: [usize; 5] = [4096, 3072, 2048, 1024, 512];

/// What `--json` holds.
#[derive(Debug, Serialize)]
struct Counts {
    convention: &'static str,
    width: usize,
    height: usize,
    num_context: usize,
    num_tokens: usize,
    rows: Vec<Row>,
}

/// One amount of work.
#[derive(Debug, Serialize)]
struct Row {
    /// `render` of a view, `encode` or `condense` of a scene.
    work: &'static str,
    /// Tokens that are drawn from, made or kept.
    num_tokens: usize,
    /// Thousands of millions in the convention.
    giga: f64,
    /// Of these, multiply-accumulates of linear layers.
    linear_macs: u64,
    /// And of attention.
    attention_macs: u64,
}

/// Sizes that work is counted of.
struct Sizes {
    model: ModelConfig,
    height: usize,
    width: usize,
    num_context: usize,
    /// Rendered and stored.
    counts: Vec<TokenCount>,
}

/// Counts, prints the table and writes the JSON.
pub fn run(args: &FlopsArgs) -> anyhow::Result<()> {
    let sizes = sizes(args)?;
    let counts = count(&sizes, args.convention)?;
    print_result(&shown(&counts, args.convention))?;
    if let Some(json) = &args.json {
        crate::output::json::write(&counts, json)?;
        print_result(&format!("results: {}", json.display()))?;
    }
    Ok(())
}

fn sizes(args: &FlopsArgs) -> anyhow::Result<Sizes> {
    let given = |default: Vec<TokenCount>| if args.render.is_empty() { default } else { args.render.clone() };
    let Some(path) = &args.config else {
        let counts = given(PAPER_TOKENS.map(TokenCount::Count).into());
        return Ok(Sizes { model: ModelConfig::default(), height: 256, width: 256, num_context: 4, counts });
    };
    let (config, overrides) = read_config::<Config>(path, &args.set)?;
    for change in overrides {
        print_note(&change.to_string());
    }
    config.validate()?;
    let Config { model, data, eval, .. } = config;
    let counts = given(eval.storage.into_iter().rev().collect());
    Ok(Sizes { model, height: data.height, width: data.width, num_context: eval.num_context, counts })
}

fn count(sizes: &Sizes, convention: FlopConvention) -> anyhow::Result<Counts> {
    let Sizes { model, height, width, num_context, counts } = sizes;
    let (height, width, num_context) = (*height, *width, *num_context);
    let num_tokens = model.num_tokens(num_context, height, width)?;
    let row = |work, num_tokens, macs: Macs| Row {
        work,
        num_tokens,
        giga: macs.count(convention) as f64 / 1e9,
        linear_macs: macs.linear,
        attention_macs: macs.attention,
    };
    let mut rows = Vec::new();
    for count in counts {
        let tokens = count.of(num_tokens)?;
        rows.push(row("render", tokens, model.render_macs(height, width, tokens)?));
    }
    // The paper tells neither; its convention is known of rendering alone.
    if convention != FlopConvention::Paper {
        rows.push(row("encode", num_tokens, model.encode_macs(num_context, height, width)?));
        for count in counts {
            let tokens = count.of(num_tokens)?;
            rows.push(row("condense", tokens, model.condense_macs(num_tokens, tokens)));
        }
    }
    Ok(Counts { convention: convention.name(), width, height, num_context, num_tokens, rows })
}

fn shown(counts: &Counts, convention: FlopConvention) -> String {
    let Counts { width, height, num_context, num_tokens, rows, .. } = counts;
    // As many digits as the paper prints.
    let cell = |giga: f64| match giga {
        giga if giga >= 100.0 => format!("{giga:.1}"),
        giga if giga >= 1.0 => format!("{giga:.2}"),
        giga => format!("{giga:.4}"),
    };
    let head = ["work", "tokens", convention.unit()].map(String::from);
    let rows = rows.iter().map(|row| [row.work.into(), row.num_tokens.to_string(), cell(row.giga)]);
    let table = table::columns(&[head].into_iter().chain(rows).collect::<Vec<_>>());
    format!("views of {width} x {height}, {num_context} context views, {num_tokens} tokens\n\n{table}")
}

/// Arguments of `clift flops`.
#[derive(Debug, clap::Args)]
pub struct FlopsArgs {
    /// The experiment whose sizes are used, a TOML file; the paper's sizes by default
    pub config: Option<PathBuf>,
    /// How to count: paper, macs or flops
    #[arg(long, default_value = "macs")]
    pub convention: FlopConvention,
    /// Numbers of rendered tokens, or shares of a scene's; those of the paper's table, or of the config, by default
    #[arg(long, value_delimiter = ',', value_name = "COUNT")]
    pub render: Vec<TokenCount>,
    /// Change a key of the config: `--set model.dim=512`
    #[arg(long, value_name = "KEY=TOML", requires = "config")]
    pub set: Vec<String>,
    /// Write the counts as JSON
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
}

#[cfg(test)]
mod tests {
    use super::*;

    fn counts(convention: FlopConvention) -> Counts {
        let args = FlopsArgs { config: None, convention, render: Vec::new(), set: Vec::new(), json: None };
        count(&sizes(&args).unwrap(), convention).unwrap()
    }

    #[test]
    fn the_papers_table_is_printed() {
        let paper = counts(FlopConvention::Paper);
        let printed: Vec<String> = paper.rows.iter().map(|row| format!("{:.2}", row.giga)).collect();
        assert_eq!(printed, ["70.59", "63.35", "56.10", "48.85", "45.23"]);
        let text = shown(&paper, FlopConvention::Paper);
        assert!(text.contains("views of 256 x 256, 4 context views, 4096 tokens"), "{text}");
        assert!(text.contains("render  512     45.23"), "{text}");
    }

    #[test]
    fn other_conventions_have_attention_the_encoder_and_the_condenser_too() {
        let (macs, flops) = (counts(FlopConvention::Macs), counts(FlopConvention::Flops));
        let works: Vec<&str> = macs.rows.iter().map(|row| row.work).collect();
        assert_eq!(works.iter().filter(|work| **work == "condense").count(), 5);
        assert!(works.contains(&"encode"));
        for (macs, flops) in macs.rows.iter().zip(&flops.rows) {
            assert!((2.0 * macs.giga - flops.giga).abs() < 1e-9);
        }
    }
}
