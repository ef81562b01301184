//! `clift bench`.

use std::path::{Path, PathBuf};

use clap::Subcommand;
use clift_bench::{BenchCase, BenchEvent, BenchOptions, BenchReport, BenchRow, MAX_CHECKED_TOKENS, run_bench};
use clift_model::{DeviceName, Precision, TokenCount};
use clift_train::{Config, read_config};

use crate::commands::bench::data::BenchDataArgs;
use crate::commands::bench::precision::BenchHalfArgs;
use crate::commands::parse::parse_repeats;
use crate::exit_code::UsageError;
use crate::interrupt;
use crate::output::counter::Counter;
use crate::output::stdout::{print_note, print_result};
use crate::output::table;
use crate::output::units::{bytes, folder_of, seconds};

/// Times what is asked for, prints the table and writes the JSON.
pub fn run(args: &BenchArgs) -> anyhow::Result<()> {
    let (mut config, overrides) = read_config::<Config>(args.config.as_deref().unwrap_or(Path::new("")), &args.set)?;
    for change in overrides {
        print_note(&change.to_string());
    }
    config.device = args.device.unwrap_or(config.device);
    // Found out now and not after minutes of work.
    if let Some(json) = &args.json
        && !folder_of(json).is_dir()
    {
        return Err(UsageError(format!("there is no folder for --json {}", json.display())).into());
    }
    let options = BenchOptions {
        cases: if args.work.is_empty() { BenchCase::ALL.into() } else { args.work.clone() },
        repeats: args.repeats,
        warmup: args.warmup,
        error: !args.no_error,
        storage: args.storage,
        render: args.render,
        features: args.features.clone(),
    };
    let stop = interrupt::flag()?;
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
    print_result(&shown(&report))?;
    if let Some(json) = &args.json {
        crate::output::json::write(&report, json)?;
        print_result(&format!("results: {}", json.display()))?;
    }
    Ok(())
}

const HEADER: [&str; 5] = ["work", "median", "p95", "peak memory", "error against f64"];

/// The table with what must be known to read it.
fn shown(report: &BenchReport) -> String {
    let rows: Vec<_> = [HEADER.map(String::from)].into_iter().chain(report.rows.iter().map(cells)).collect();
    let half = if report.precision == Precision::F16 { ", f16 products" } else { "" };
    let title = format!("{}, {} threads{half}\n", report.device, report.threads);
    [title, table::columns(&rows)].into_iter().chain(remarks(&report.rows)).collect::<Vec<_>>().join("\n")
}

/// What must be known to read the rows, after an empty line.
fn remarks(rows: &[BenchRow]) -> Vec<String> {
    let has = |test: &dyn Fn(&BenchRow) -> bool| rows.iter().any(test);
    let inertia = rows.iter().find_map(|row| row.inertia);
    let mut remarks: Vec<String> = [
        has(&|row| row.case == BenchCase::Render8Views).then(|| "render_8_views: seconds are per view".into()),
        inertia.map(|inertia| format!("kmeans: inertia {inertia:.6e}; its error is the inertia's")),
        has(&|row| row.max_rel_error.is_some() && row.case.is_checked_reduced())
            .then(|| format!("* of loss and gradients, with at most {MAX_CHECKED_TOKENS} tokens")),
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
    let peak = row.peak_bytes.map_or_else(|| "unknown".into(), bytes);
    [row.case.to_string(), seconds(row.median_s), seconds(row.p95_s), peak, error]
}

/// What is timed instead of the parts of the method.
#[derive(Debug, Subcommand)]
pub enum BenchCommand {
    /// Time how fast clips are read from a folder, in order and at random
    Data(BenchDataArgs),
    /// Time f16 products beside f32 ones, in turn, with what they change: loss, PSNR and gradient
    Half(BenchHalfArgs),
}

/// Arguments of `clift bench`.
#[derive(Debug, clap::Args)]
#[command(args_conflicts_with_subcommands = true, subcommand_negates_reqs = true)]
pub struct BenchArgs {
    /// Something else to time.
    #[command(subcommand)]
    pub command: Option<BenchCommand>,
    /// The experiment whose sizes are used, a TOML file
    #[arg(required = true)]
    pub config: Option<PathBuf>,
    /// The rows; all of them by default
    #[arg(long, value_delimiter = ',', value_name = "WORK", help = cases_help())]
    pub work: Vec<BenchCase>,
    /// Repetitions that count
    #[arg(long, value_name = "COUNT", default_value = "5", value_parser = parse_repeats)]
    pub repeats: usize,
    /// Repetitions before them that do not
    #[arg(long, value_name = "COUNT", default_value = "1")]
    pub warmup: usize,
    /// Leave out the comparison with f64
    #[arg(long)]
    pub no_error: bool,
    /// Where tensors live: flex, ndarray or wgpu
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<DeviceName>,
    /// Change a key of the config: `--set stage1.batch_size=1`
    #[arg(long, value_name = "KEY=TOML")]
    pub set: Vec<String>,
    /// Tokens that are stored, as a number or a share: clusters of K-means, condenser and stage 2
    #[arg(long, value_name = "COUNT", default_value = "1/4")]
    pub storage: TokenCount,
    /// Tokens that `render` and `render_8_views` draw from, as a number or a share; all by default
    #[arg(long, value_name = "COUNT")]
    pub render: Option<TokenCount>,
    /// Let K-means cluster the tensor `features`, [N, D] in f32, of a safetensors file
    #[arg(long, value_name = "FILE")]
    pub features: Option<PathBuf>,
    /// Write the figures, with every repetition, as JSON
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
}

fn cases_help() -> String {
    format!("Time these works alone: {}", BenchCase::names())
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
            samples_s: vec![median_s],
            inertia,
        }
    }

    #[test]
    fn the_table_says_what_each_figure_is_of() {
        let rows = vec![
            row(BenchCase::Encode, 12.345, Some(3 << 30), Some(3.14e-7)),
            row(BenchCase::Kmeans, 0.5, Some(700 << 20), Some(f64::NAN)),
            row(BenchCase::Render8Views, 0.0123, None, None),
            row(BenchCase::Stage1Step, 123.4, None, Some(2e-5)),
        ];
        let expected = "\
flex, 2 threads

work            median   p95      peak memory  error against f64
encode          12.3 s   24.7 s   3.00 GiB     3.1e-7
kmeans          500 ms   1.00 s   700 MiB      not finite
render_8_views  12.3 ms  24.6 ms  unknown      -
stage1_step     123 s    247 s    unknown      2.0e-5 *

render_8_views: seconds are per view
kmeans: inertia 1.234500e3; its error is the inertia's
* of loss and gradients, with at most 1024 tokens
- not compared with f64";
        assert_eq!(
            shown(&BenchReport { device: DeviceName::Flex, precision: Precision::F32, threads: 2, rows }),
            expected
        );
    }

    #[test]
    fn a_table_without_remarks_ends_with_its_last_row() {
        let rows = vec![row(BenchCase::Encode, 0.002, Some(1 << 20), Some(1e-7))];
        let text = shown(&BenchReport { device: DeviceName::Flex, precision: Precision::F32, threads: 1, rows });
        assert!(text.ends_with("\nencode  2.00 ms  4.00 ms  1 MiB        1.0e-7"), "{text}");
    }

    #[test]
    fn the_json_has_the_named_keys_and_null_where_nothing_was_measured() {
        let rows =
            vec![row(BenchCase::Kmeans, 0.5, Some(7), Some(0.25)), row(BenchCase::Render8Views, 0.5, None, None)];
        let json =
            serde_json::to_value(BenchReport { device: DeviceName::Flex, precision: Precision::F32, threads: 2, rows })
                .unwrap();
        let expected = serde_json::json!({
            "device": "flex",
            "precision": "f32",
            "threads": 2,
            "rows": [
                {"work": "kmeans", "median_s": 0.5, "p95_s": 1.0, "peak_bytes": 7, "max_rel_error": 0.25,
                    "samples_s": [0.5], "inertia": 1234.5},
                {"work": "render_8_views", "median_s": 0.5, "p95_s": 1.0, "peak_bytes": null,
                    "max_rel_error": null, "samples_s": [0.5]},
            ],
        });
        assert_eq!(json, expected);
    }
}
