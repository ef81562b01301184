//! `clift bench data`.

use std::path::PathBuf;

use anyhow::Context;
use clift_bench::{Throughput, ThroughputOptions, measure_reading};
use clift_data::{ClipOptions, FileOptions, PoseRotation, PoseScale, replace_file};
use clift_eval::{peak_bytes, start_peak};
use serde::Serialize;

use crate::commands::parse::parse_size;
use crate::commands::splits::{Splits, splits};
use crate::exit_code::UsageError;
use crate::output::stdout::print_result;
use crate::output::table;

/// Arguments of `clift bench data`.
#[derive(Debug, clap::Args)]
pub struct BenchDataArgs {
    /// The data, in any layout
    pub dir: PathBuf,
    /// Half that is read
    #[arg(long, value_enum, default_value_t = Splits::Train)]
    pub split: Splits,
    /// Columns and rows of a view
    #[arg(long, value_name = "WxH", default_value = "256x256", value_parser = parse_size)]
    pub size: [usize; 2],
    /// Context and target frames of a clip
    #[arg(long, value_name = "C+T", default_value = "4+6", value_parser = parse_views)]
    pub views: [usize; 2],
    /// Clips of each measurement
    #[arg(long, value_name = "N", default_value_t = 200)]
    pub clips: usize,
    /// Threads that read in order; random clips are read on one
    #[arg(long, value_name = "N", default_value_t = 2)]
    pub threads: usize,
    /// Decides which frames and, at random, which scenes
    #[arg(long, value_name = "S", default_value_t = 0)]
    pub seed: u64,
    /// Write the figures and the clips that were read as JSON
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
}

/// What `--json` writes.
#[derive(Debug, Serialize)]
struct Report {
    /// Most memory of this process while it opened and read.
    peak_bytes: Option<u64>,
    #[serde(flatten)]
    throughput: Throughput,
}

/// Measures and prints.
pub fn run(args: &BenchDataArgs) -> anyhow::Result<()> {
    let _peak = start_peak();
    let Some(half) = splits(&args.dir, args.split, &FileOptions::default())?.pop() else {
        return Err(UsageError(format!("{} holds no scenes", args.dir.display())).into());
    };
    let [width, height] = args.size;
    let clip = ClipOptions {
        width,
        height,
        pose_rotation: PoseRotation::default(),
        pose_scale: PoseScale::default(),
        exact_principal_point: false,
    };
    let options = ThroughputOptions {
        clip,
        num_views: args.views,
        num_clips: args.clips,
        num_threads: args.threads,
        seed: args.seed,
    };
    let throughput = measure_reading(&half.opened.source, &options)?;
    let report = Report { peak_bytes: peak_bytes(), throughput };
    print_result(&shown(&report, args.views))?;
    if let Some(path) = &args.json {
        let text = serde_json::to_vec_pretty(&report).context("writing the figures as JSON")?;
        replace_file(path, &text).with_context(|| format!("writing {}", path.display()))?;
    }
    Ok(())
}

fn shown(report: &Report, [num_context, num_targets]: [usize; 2]) -> String {
    let Throughput { size: [width, height], num_threads, .. } = report.throughput;
    let figures = &report.throughput;
    let memory = report.peak_bytes.map_or_else(|| "unknown".into(), |bytes| format!("{} MB", bytes / 1_000_000));
    let rows = [
        ["in order".to_owned(), format!("{:.1} clips/s on {num_threads} threads", figures.sequential_clips_per_s)],
        ["at random".into(), format!("{:.1} clips/s on one thread", figures.random_clips_per_s)],
        [
            "a random clip".into(),
            format!("{:.1} ms (95 of 100: {:.1} ms)", figures.random_median_s * 1e3, figures.random_p95_s * 1e3),
        ],
        ["peak memory".into(), memory],
    ];
    let title = format!("clips of {num_context} + {num_targets} frames, {width}x{height}");
    format!("{title}\n{}", table::columns(&rows))
}

fn parse_views(text: &str) -> Result<[usize; 2], String> {
    let views = text.split_once('+').and_then(|(context, target)| Some([context.parse().ok()?, target.parse().ok()?]));
    // Poses are normalised by the contexts: one has no scale.
    views.filter(|[context, _]| *context >= 2).ok_or_else(|| "write contexts, 2 or more, and targets, as 4+6".into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_are_shown_with_their_units() {
        let throughput = Throughput {
            size: [256, 256],
            num_threads: 2,
            sequential_clips_per_s: 51.26,
            random_median_s: 0.0301,
            random_p95_s: 0.05,
            random_clips_per_s: 33.0,
            sequential: Vec::new(),
            random: Vec::new(),
        };
        let text = shown(&Report { peak_bytes: Some(123_456_789), throughput }, [4, 6]);
        let expected = "\
clips of 4 + 6 frames, 256x256
in order       51.3 clips/s on 2 threads
at random      33.0 clips/s on one thread
a random clip  30.1 ms (95 of 100: 50.0 ms)
peak memory    123 MB";
        assert_eq!(text, expected);
        assert_eq!(parse_views("4+6"), Ok([4, 6]));
        assert!(parse_views("4").is_err() && parse_views("1+6").is_err());
    }
}
