//! `clift bench data`.

use std::path::PathBuf;

use clift_bench::{Throughput, ThroughputOptions, measure_reading};
use clift_data::{ClipOptions, FileOptions};
use clift_eval::{peak_bytes, start_peak, table};
use serde::Serialize;

use crate::commands::args::parse::{parse_input, parse_size, parse_views};
use crate::commands::args::shared_args::JsonArg;
use crate::commands::args::splits::{Splits, open_splits};
use crate::exit_code::usage_bail;
use crate::output::stdout::print_result;
use crate::output::units::{memory_size, seconds};

#[derive(Debug, clap::Args)]
pub struct BenchDataArgs {
    /// Data set in any layout
    #[arg(value_parser = parse_input)]
    pub dir: PathBuf,
    /// Read this split
    #[arg(long, value_enum, default_value_t = Splits::Train)]
    pub split: Splits,
    /// Set width and height of a view, in pixels
    #[arg(long, value_name = "WxH", default_value = "256x256", value_parser = parse_size)]
    pub size: [usize; 2],
    /// Set context and target frames of a clip
    #[arg(long, value_name = "C+T", default_value = "4+6", value_parser = parse_views)]
    pub views: [usize; 2],
    /// Read this many clips in each measurement
    #[arg(long, value_name = "N", default_value_t = 200)]
    pub clips: usize,
    /// Threads for reading in order; random clips are read on one
    #[arg(long, value_name = "N", default_value_t = 2)]
    pub threads: usize,
    /// Seed of the sampled frames and of the random scenes
    #[arg(long, value_name = "S", default_value_t = 0)]
    pub seed: u64,
    #[command(flatten)]
    pub json: JsonArg,
}

/// Content of `--json`.
#[derive(Debug, Serialize)]
struct Report {
    /// Peak memory of the process while it opened and read the data.
    peak_bytes: Option<u64>,
    #[serde(flatten)]
    throughput: Throughput,
}

pub fn run(args: &BenchDataArgs) -> anyhow::Result<()> {
    let json = args.json.open(&[&args.dir])?;
    let _peak = start_peak();
    if args.split == Splits::Both {
        usage_bail!("--split both: one split is measured; write train or test");
    }
    let Some(split) = open_splits(&args.dir, args.split, &FileOptions::default())?.pop() else {
        usage_bail!("no scenes in {}", args.dir.display());
    };
    let [width, height] = args.size;
    let clip = ClipOptions { width, height, ..ClipOptions::default() };
    let options = ThroughputOptions {
        clip,
        num_views: args.views,
        num_clips: args.clips,
        num_threads: args.threads,
        seed: args.seed,
    };
    let throughput = measure_reading(&split.opened.source, &options)?;
    let report = Report { peak_bytes: peak_bytes(), throughput };
    print_result(&report_text(&report, args.views))?;
    json.write(&report)
}

fn report_text(report: &Report, [num_context, num_targets]: [usize; 2]) -> String {
    let figures = &report.throughput;
    let Throughput { size: [width, height], num_threads, .. } = figures;
    let memory = report.peak_bytes.map_or_else(|| "unknown".into(), memory_size);
    let rows = [
        ["in order".to_owned(), format!("{:.1} clips/s on {num_threads} threads", figures.sequential_clips_per_s)],
        ["at random".into(), format!("{:.1} clips/s on one thread", figures.random_clips_per_s)],
        [
            "one at random".into(),
            format!("{} (p95: {})", seconds(figures.random_median_s), seconds(figures.random_p95_s)),
        ],
        ["peak memory".into(), memory],
    ];
    let title = format!("clips of {num_context} + {num_targets} frames, {width}x{height}");
    format!("{title}\n\n{}", table(["read", "speed"], rows))
}
