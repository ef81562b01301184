//! `clift flops`.

use std::path::PathBuf;

use clift_eval::table;
use clift_model::{FlopConvention, Macs, TokenCount, parse_value};
use clift_train::{Config, check_plan};
use serde::Serialize;

use crate::commands::args::shared_args::{JsonArg, read_config};
use crate::output::stdout::print_result;

/// Token counts of the paper's table of rendering costs.
const PAPER_TOKENS: [usize; 5] = [4096, 3072, 2048, 1024, 512];

/// Content of `--json`.
#[derive(Debug, Serialize)]
struct Counts {
    convention: &'static str,
    width: usize,
    height: usize,
    num_context: usize,
    num_tokens: usize,
    rows: Vec<Row>,
}

#[derive(Debug, Serialize)]
struct Row {
    /// `render` (per view), `encode` or `condense` (per scene).
    work: &'static str,
    /// Tokens that are rendered from, encoded or stored.
    num_tokens: usize,
    /// Cost in 10^9 units of the convention.
    giga: f64,
    linear_macs: u64,
    attention_macs: u64,
}

pub fn run(args: &FlopsArgs) -> anyhow::Result<()> {
    let (config, json, default) = match args.config.as_deref() {
        Some(path) => {
            let (config, _) = read_config(path, &args.set, check_plan)?;
            let json = args.json.open_for(path, &config)?;
            let counts: Vec<TokenCount> = config.eval_stored_tokens().into_iter().rev().collect();
            (config, json, counts)
        }
        // The defaults of a config are the sizes of the paper.
        None => (Config::default(), args.json.open(&[])?, PAPER_TOKENS.map(TokenCount::Count).into()),
    };
    let tokens = if args.render.is_empty() { default } else { args.render.clone() };
    let counts = count(&config, &tokens, args.convention)?;
    print_result(&report_text(&counts, args.convention))?;
    json.write(&counts)
}

fn count(config: &Config, counts: &[TokenCount], convention: FlopConvention) -> anyhow::Result<Counts> {
    let Config { model, data, eval, .. } = config;
    let (height, width, num_context) = (data.height, data.width, eval.num_context);
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
    // The paper counts rendering only.
    if convention != FlopConvention::Paper {
        rows.push(row("encode", num_tokens, model.encode_macs(num_context, height, width)?));
        for count in counts.iter().filter(|_| model.architecture.supports_clusters()) {
            let tokens = count.of(num_tokens)?;
            rows.push(row("condense", tokens, model.condense_macs(num_tokens, tokens)));
        }
    }
    Ok(Counts { convention: convention.into(), width, height, num_context, num_tokens, rows })
}

fn report_text(counts: &Counts, convention: FlopConvention) -> String {
    let Counts { width, height, num_context, num_tokens, rows, .. } = counts;
    // The precision of the paper's table.
    let cell = |giga: f64| match giga {
        giga if giga >= 100.0 => format!("{giga:.1}"),
        giga if giga >= 1.0 => format!("{giga:.2}"),
        giga => format!("{giga:.4}"),
    };
    let rows = rows.iter().map(|row| [row.work.into(), row.num_tokens.to_string(), cell(row.giga)]);
    let table = table(["part", "tokens", convention.unit()], rows);
    format!("views of {width} x {height}, {num_context} context views, {num_tokens} tokens\n\n{table}")
}

#[derive(Debug, clap::Args)]
pub struct FlopsArgs {
    /// Config file (TOML) with the sizes to count [default: the paper's sizes]
    pub config: Option<PathBuf>,
    /// Counting convention: paper or macs
    #[arg(long, default_value = "macs", value_parser = |name: &str| parse_value::<FlopConvention>("convention", name))]
    pub convention: FlopConvention,
    /// Rendered tokens, as numbers or shares [default: the paper's, or the config's]
    #[arg(long, value_delimiter = ',', value_name = "COUNT")]
    pub render: Vec<TokenCount>,
    /// Override a key of the config, e.g. `model.dim=512`; repeatable
    #[arg(long, value_name = "KEY=TOML", requires = "config")]
    pub set: Vec<String>,
    #[command(flatten)]
    pub json: JsonArg,
}
