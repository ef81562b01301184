//! `clift bench`.

use std::path::{Path, PathBuf};

use clap::Subcommand;
use clift_bench::{BenchCase, BenchEvent, BenchOptions, BenchReport, BenchRow, MAX_CHECKED_TOKENS, run_bench};
use clift_eval::table;
use clift_model::Precision;

use crate::commands::bench::data::BenchDataArgs;
use crate::commands::bench::precision::BenchPrecisionArgs;
use crate::commands::bench::timing_args::TimingArgs;
use crate::interrupt::{self, Ending};
use crate::output::counter::Counter;
use crate::output::stdout::print_result;
use crate::output::units::{memory_size, seconds};

pub fn run(args: &BenchArgs) -> anyhow::Result<()> {
    let timing = &args.timing;
    let path = args.config.as_deref().unwrap_or(Path::new(""));
    let config = timing.config.read(path, |_| Ok(()))?;
    let json = timing.json.open_for(path, &config)?;
    let options = timing.options(BenchCase::ALL);
    let options = BenchOptions { error: !args.no_error, features: args.features.clone(), ..options };
    let stop = interrupt::flag(Ending::WITHOUT_RESULTS)?;
    let mut counter: Option<Counter> = None;
    let report = run_bench(&config, &options, &stop, &mut |event| match event {
        BenchEvent::Progress { done, total } => {
            counter.get_or_insert_with(|| Counter::new("bench", total as u64)).set(done as u64);
        }
        BenchEvent::Finished(row) => {
            if let Some(counter) = &counter {
                counter.note(&format!("{}: {}", row.case, seconds(row.median_s)));
            }
        }
    });
    drop(counter);
    let report = report?;
    print_result(&report_text(&report))?;
    json.write(&report)
}

fn report_text(report: &BenchReport) -> String {
    let header = ["case", "median", "p95", "GFLOP/s", "peak memory", "error against f64"];
    let reduced = Some(report.precision).filter(|precision| *precision != Precision::F32);
    let products = reduced.map_or_else(String::new, |precision| format!(", {precision} products"));
    let peak = report.peak_flops.map_or_else(String::new, |peak| format!(", peak {:.0} GFLOP/s", peak / 1e9));
    let title = format!("{}, {} threads{products}{peak}\n", report.device, report.threads);
    let table = table(header, report.rows.iter().map(|row| cells(row, report.peak_flops)));
    [title, table].into_iter().chain(remarks(&report.rows)).collect::<Vec<_>>().join("\n")
}

fn remarks(rows: &[BenchRow]) -> Vec<String> {
    let has = |test: &dyn Fn(&BenchRow) -> bool| rows.iter().any(test);
    let inertia = rows.iter().find_map(|row| row.inertia);
    let mut remarks: Vec<String> = [
        has(&|row| row.case == BenchCase::Render8Views).then(|| "render_8_views: seconds per view".into()),
        inertia.map(|inertia| format!("kmeans: inertia {inertia:.6e}; the error is that of the inertia")),
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

fn cells(row: &BenchRow, peak: Option<f64>) -> [String; 6] {
    let mark = if row.case.is_checked_reduced() { " *" } else { "" };
    let error = match row.max_rel_error {
        None => "-".into(),
        Some(error) if error.is_finite() => format!("{error:.1e}{mark}"),
        Some(_) => format!("not finite{mark}"),
    };
    let memory = row.peak_bytes.map_or_else(|| "unknown".into(), memory_size);
    let speed = row.flops.map(|flops| flops / row.median_s);
    let share = speed.zip(peak).map_or_else(String::new, |(speed, peak)| format!(" ({:.0} %)", 1e2 * speed / peak));
    let speed = speed.map_or_else(|| "-".into(), |speed| format!("{:.0}{share}", speed / 1e9));
    [row.case.to_string(), seconds(row.median_s), seconds(row.p95_s), speed, memory, error]
}

/// Measurements other than the cases of a config.
#[derive(Debug, Subcommand)]
pub enum BenchCommand {
    /// Time reading clips from a data set, in order and at random
    Data(BenchDataArgs),
    /// Compare f16 or bf16 with f32 matrix products: time, loss, PSNR, gradient
    Precision(BenchPrecisionArgs),
}

#[derive(Debug, clap::Args)]
#[command(args_conflicts_with_subcommands = true, subcommand_negates_reqs = true)]
#[command(after_help = format!("Cases:\n  {}", BenchCase::names()))]
pub struct BenchArgs {
    /// Another measurement.
    #[command(subcommand)]
    pub command: Option<BenchCommand>,
    /// Config file (TOML) with the sizes to time
    #[arg(required = true)]
    pub config: Option<PathBuf>,
    #[command(flatten)]
    pub timing: TimingArgs,
    /// Skip the comparison with f64
    #[arg(long)]
    pub no_error: bool,
    /// Cluster `features`, f32 [N, D], of this safetensors file in `kmeans`
    #[arg(long, value_name = "FILE")]
    pub features: Option<PathBuf>,
}

#[cfg(test)]
mod tests {
    use clift_model::DeviceName;

    use super::*;

    fn row(case: BenchCase, median_s: f64, peak_bytes: Option<u64>, max_rel_error: Option<f64>) -> BenchRow {
        let inertia = (case == BenchCase::Kmeans).then_some(1234.5);
        BenchRow {
            case,
            median_s,
            p95_s: median_s * 2.0,
            peak_bytes,
            max_rel_error,
            flops: (case == BenchCase::Encode).then_some(1e12),
            samples_s: vec![median_s],
            inertia,
        }
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
flex, 2 threads, peak 300 GFLOP/s

case            median   p95      GFLOP/s    peak memory  error against f64
encode          12.3 s   24.7 s   81 (27 %)  3.00 GiB     3.1e-7
kmeans          500 ms   1.00 s   -          700 MiB      not finite
render_8_views  12.3 ms  24.6 ms  -          unknown      -
stage1_step     123 s    247 s    -          unknown      2.0e-5 *

render_8_views: seconds per view
kmeans: inertia 1.234500e3; the error is that of the inertia
* error of loss and gradients, with at most 1024 tokens
- not compared with f64";
        let (device, precision, peak_flops) = (DeviceName::Flex, Precision::F32, Some(3e11));
        let mut report = BenchReport { device, precision, threads: 2, peak_flops, rows };
        assert_eq!(report_text(&report), expected);
        report.rows.truncate(1);
        assert!(report_text(&report).ends_with("\nencode  12.3 s  24.7 s  81 (27 %)  3.00 GiB     3.1e-7"));
    }
}
