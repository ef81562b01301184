//! `clift bench allreduce`.

use clift_bench::{AllReduceReport, AllReduceRow, measure_allreduce};

use clift_eval::table;

use crate::commands::args::parse::parse_count;
use crate::commands::args::shared_args::JsonArg;
use crate::commands::ranks::{connect, finish};
use crate::output::stdout::print_result;
use crate::output::units::{file_size, seconds};

#[derive(Debug, clap::Args)]
pub struct BenchAllReduceArgs {
    /// Numbers of summed values; the last default is the paper's network
    #[arg(long, value_name = "N,..", value_delimiter = ',', value_parser = parse_count)]
    #[arg(default_values_t = [1, 262_144, 16_777_216, 81_239_232])]
    pub values: Vec<usize>,
    /// Timed repetitions
    #[arg(long, value_name = "N", value_parser = parse_count, default_value_t = 7)]
    pub repeats: usize,
    #[command(flatten)]
    pub json: JsonArg,
}

pub fn run(args: &BenchAllReduceArgs) -> anyhow::Result<()> {
    let ranks = connect()?;
    let measure = || -> anyhow::Result<()> {
        let json = ranks.is_root().then(|| args.json.open(&[])).transpose()?;
        let report = measure_allreduce(&ranks, &args.values, args.repeats)?;
        if let Some(json) = json {
            print_result(&report_text(&report))?;
            json.write(&report)?;
        }
        Ok(())
    };
    finish(&ranks, measure())
}

fn report_text(report: &AllReduceReport) -> String {
    let header = ["values", "size", "median", "p95", "sent by a rank"];
    let title = format!("{} ranks, a message to all: {:.0} us\n", report.num_ranks, 1e6 * report.message_s);
    [title, table(header, report.rows.iter().map(cells))].join("\n")
}

fn cells(row: &AllReduceRow) -> [String; 5] {
    let rate = if row.sent_bytes == 0 { "-".into() } else { format!("{:.2} GB/s", row.gb_per_s()) };
    let size = file_size(4 * row.num_values as u64);
    [row.num_values.to_string(), size, seconds(row.median_s), seconds(row.p95_s), rate]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn table_has_bandwidth_of_what_is_sent() {
        let row = |num_values, sent_bytes| AllReduceRow { num_values, median_s: 0.1, p95_s: 0.2, sent_bytes };
        let report =
            AllReduceReport { num_ranks: 2, message_s: 2.5e-5, rows: vec![row(1, 0), row(25_000_000, 100_000_000)] };
        let expected = "\
2 ranks, a message to all: 25 us

values    size      median  p95     sent by a rank
1         4 bytes   100 ms  200 ms  -
25000000  100.0 MB  100 ms  200 ms  1.00 GB/s";
        assert_eq!(report_text(&report), expected);
    }
}
