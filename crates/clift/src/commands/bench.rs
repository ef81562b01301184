//! `clift bench`.

use std::path::PathBuf;

use clift_bench::{
    BenchCase, BenchOptions, BenchReport, BenchRow, Card, Ledger, MAX_CHECKED_TOKENS, run_bench, run_ledger,
};
use clift_eval::table;
use clift_model::{KernelLaunches, Precision, TokenCount, names};

use crate::commands::args::parse::parse_count;
use crate::commands::args::shared_args::{ConfigArgs, JsonArg};
use crate::interrupt::{self, Ending};
use crate::output::stdout::{print_note, print_result};
use crate::output::units::{memory_size, seconds};

pub fn run(args: &BenchArgs) -> anyhow::Result<()> {
    let config = args.overrides.read(&args.config, |_| Ok(()))?;
    let json = args.json.open_for(&args.config, &config)?;
    let options = BenchOptions {
        cases: if args.cases.is_empty() { BenchCase::ALL.into() } else { args.cases.clone() },
        repeats: args.repeats,
        warmup: args.warmup,
        error: !args.no_error,
        stored_tokens: args.stored_tokens,
    };
    let stop = interrupt::flag(Ending::WITHOUT_RESULTS)?;
    if args.ledger {
        let ledger = run_ledger(&config, &options, &stop, &mut |row| {
            print_note(&format!("{}: {} launches", row.case, row.count()));
        })?;
        print_result(&ledger_text(&ledger, args.card))?;
        return json.write(&ledger);
    }
    let report = run_bench(&config, &options, &stop, &mut |row| {
        print_note(&format!("{}: {}", row.case, seconds(row.median_s)));
    })?;
    print_result(&report_text(&report))?;
    json.write(&report)
}

fn report_text(report: &BenchReport) -> String {
    let header = ["case", "median", "p95", "peak memory", "error against f64"];
    let reduced = Some(report.precision).filter(|precision| *precision != Precision::F32);
    let products = reduced.map_or_else(String::new, |precision| format!(", {precision} products"));
    let title = format!("{}, {} threads{products}\n", report.device, report.threads);
    let table = table(header, report.rows.iter().map(cells));
    [title, table].into_iter().chain(remarks(&report.rows)).collect::<Vec<_>>().join("\n")
}

fn remarks(rows: &[BenchRow]) -> Vec<String> {
    let has = |test: &dyn Fn(&BenchRow) -> bool| rows.iter().any(test);
    let mut remarks: Vec<String> = [
        has(&|row| row.case == BenchCase::Render8Views).then(|| "render_8_views: seconds per view".into()),
        has(&|row| row.case == BenchCase::Kmeans && row.max_rel_error.is_some())
            .then(|| "kmeans: the error is that of the inertia".into()),
        has(&|row| row.max_rel_error.is_some() && row.case.is_checked_reduced())
            .then(|| format!("* error of loss and gradients, with at most {MAX_CHECKED_TOKENS} tokens")),
        has(&|row| row.max_rel_error.is_none()).then(|| "- not compared with f64".into()),
    ]
    .into_iter()
    .flatten()
    .collect();
    if !remarks.is_empty() {
        remarks.insert(0, String::new());
    }
    remarks
}

fn cells(row: &BenchRow) -> [String; 5] {
    let mark = if row.case.is_checked_reduced() { " *" } else { "" };
    let error = match row.max_rel_error {
        None => "-".into(),
        Some(error) if error.is_finite() => format!("{error:.1e}{mark}"),
        Some(_) => format!("not finite{mark}"),
    };
    let memory = row.peak_bytes.map_or_else(|| "unknown".into(), memory_size);
    [row.case.to_string(), seconds(row.median_s), seconds(row.p95_s), memory, error]
}

fn ledger_text(ledger: &Ledger, card: Option<Card>) -> String {
    let Ledger { adapter, precision, is_timed, rows } = ledger;
    let run = if *is_timed { "" } else { "; compiled, not run" };
    let time = |value: Option<f64>| value.map_or_else(|| "-".into(), seconds);
    let operations = |flops: u64| if flops == 0 { "-".into() } else { format!("{:.1}", flops as f64 / 1e9) };
    let tables = rows.iter().map(|row| {
        let bound =
            |kernels: &[KernelLaunches]| card.map(|card| kernels.iter().map(|kernel| card.bound_s(kernel)).sum());
        let cells = |name: &str, count: usize, bytes: String, flops, times: [Option<f64>; 2]| {
            let [on_device, bound] = times.map(time);
            [name.into(), count.to_string(), bytes, operations(flops), on_device, bound]
        };
        let times = [row.seconds(), bound(&row.kernels)];
        let total = cells("all", row.count(), memory_size(row.bytes()), row.flops(), times);
        let kernels = row.kernels.iter().map(|kernel| {
            let bytes = kernel.bytes.map_or_else(|| "-".into(), memory_size);
            let times = [kernel.seconds, bound(std::slice::from_ref(kernel)).filter(|bound| *bound > 0.0)];
            cells(&kernel.kernel, kernel.count, bytes, kernel.flops, times)
        });
        let reserved = row.reserved_bytes.map_or_else(|| "unknown".into(), memory_size);
        let header = ["kernel", "launches", "bytes", "GFLOP", "time", "least time"];
        format!("\n{} ({reserved} of memory held)\n\n{}", row.case, table(header, [total].into_iter().chain(kernels)))
    });
    let title = format!("{adapter}, {precision} products{run}\nbytes of the buffers of all launches, without Burn's");
    let projection = card.map(|card| {
        format!("least time: a projection for {card}: bytes over its bandwidth or GFLOP over its rate, without Burn's kernels")
    });
    [title].into_iter().chain(projection).chain(tables).collect::<Vec<_>>().join("\n")
}

#[derive(Debug, clap::Args)]
#[command(after_help = format!("Cases:\n  {}", names::<BenchCase>()))]
pub struct BenchArgs {
    /// Config file (TOML) with the sizes to time
    pub config: PathBuf,
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
    pub stored_tokens: TokenCount,
    #[command(flatten)]
    pub overrides: ConfigArgs,
    #[command(flatten)]
    pub json: JsonArg,
    /// Skip the comparison with f64
    #[arg(long)]
    pub no_error: bool,
    /// List the kernels that the cases launch on a GPU, with their time on the device (not on a software adapter)
    #[arg(long, conflicts_with_all = ["repeats", "no_error"])]
    pub ledger: bool,
    /// Print the least time of the kernels on a card, from its bandwidth and arithmetic rate: h100, 4090 or m3max
    #[arg(long, requires = "ledger", value_name = "CARD")]
    pub card: Option<Card>,
}

#[cfg(test)]
mod tests {
    use clift_model::DeviceName;

    use super::*;

    fn row(case: BenchCase, median_s: f64, peak_bytes: Option<u64>, max_rel_error: Option<f64>) -> BenchRow {
        BenchRow { case, median_s, p95_s: median_s * 2.0, peak_bytes, max_rel_error, samples_s: vec![median_s] }
    }

    #[test]
    fn table_has_units_and_remarks() {
        let rows = vec![
            row(BenchCase::Encode, 12.345, Some(3 << 30), Some(3.14e-7)),
            row(BenchCase::Kmeans, 0.5, Some(700 << 20), Some(f64::NAN)),
            row(BenchCase::Render8Views, 0.0123, None, None),
            row(BenchCase::Stage1Step, 123.4, None, Some(2e-5)),
        ];
        let expected = "\
flex, 2 threads

case            median   p95      peak memory  error against f64
encode          12.3 s   24.7 s   3.00 GiB     3.1e-7
kmeans          500 ms   1.00 s   700.00 MiB   not finite
render_8_views  12.3 ms  24.6 ms  unknown      -
stage1_step     123 s    247 s    unknown      2.0e-5 *

render_8_views: seconds per view
kmeans: the error is that of the inertia
* error of loss and gradients, with at most 1024 tokens
- not compared with f64";
        let (device, precision) = (DeviceName::Flex, Precision::F32);
        let mut report = BenchReport { device, precision, threads: 2, rows };
        assert_eq!(report_text(&report), expected);
        report.rows.truncate(1);
        assert!(report_text(&report).ends_with("\nencode  12.3 s  24.7 s  3.00 GiB     3.1e-7"));
    }
}
