//! Options of `clift bench` and `clift bench precision`.

use clift_bench::{BenchCase, BenchOptions};
use clift_model::TokenCount;

use crate::commands::args::parse::parse_count;
use crate::commands::args::shared_args::{ConfigArgs, JsonArg};

/// What is timed, and how often.
#[derive(Debug, clap::Args)]
pub struct TimingArgs {
    /// Time these cases, separated by commas [default: all]
    #[arg(long = "case", value_delimiter = ',', value_name = "CASE")]
    pub cases: Vec<BenchCase>,
    /// Timed repetitions
    #[arg(long, value_name = "COUNT", default_value = "5", value_parser = parse_count)]
    pub repeats: usize,
    /// Warm-up repetitions
    #[arg(long, value_name = "COUNT", default_value = "1")]
    pub warmup: usize,
    /// Set the stored tokens, as a number or a share
    #[arg(long, value_name = "COUNT", default_value = "1/4")]
    pub storage: TokenCount,
    /// Set the tokens a view is rendered from, as a number or a share [default: all]
    #[arg(long, value_name = "COUNT")]
    pub render: Option<TokenCount>,
    #[command(flatten)]
    pub config: ConfigArgs,
    #[command(flatten)]
    pub json: JsonArg,
}

impl TimingArgs {
    pub fn options(&self, all: &[BenchCase]) -> BenchOptions {
        BenchOptions {
            cases: if self.cases.is_empty() { all.into() } else { self.cases.clone() },
            repeats: self.repeats,
            warmup: self.warmup,
            error: false,
            storage: self.storage,
            render: self.render,
            features: None,
        }
    }
}
