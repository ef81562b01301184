//! `clift bench half`.

use std::path::PathBuf;

use clift_bench::{BenchCase, BenchOptions, PRECISION_CASES, PrecisionReport, PrecisionRow, compare_precision};
use clift_model::{DeviceName, TokenCount};
use clift_train::{Config, read_config};

use crate::commands::parse::parse_repeats;
use crate::interrupt;
use crate::output::stdout::{print_note, print_result};
use crate::output::table;
use crate::output::units::seconds;

/// Arguments of `clift bench half`.
#[derive(Debug, clap::Args)]
pub struct BenchHalfArgs {
    /// The experiment whose sizes are used, a TOML file
    pub config: PathBuf,
    /// Rows of the table, separated by commas; all of them by default
    #[arg(long, value_delimiter = ',', value_name = "WORK")]
    pub work: Vec<BenchCase>,
    /// Repetitions that count
    #[arg(long, value_name = "COUNT", default_value = "5", value_parser = parse_repeats)]
    pub repeats: usize,
    /// Repetitions before them that do not
    #[arg(long, value_name = "COUNT", default_value = "1")]
    pub warmup: usize,
    /// Where tensors live: flex or wgpu
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<DeviceName>,
    /// Change a key of the config: `--set stage1.batch_size=1`
    #[arg(long, value_name = "KEY=TOML")]
    pub set: Vec<String>,
    /// Tokens that are stored, as a number or a share, for stage 2
    #[arg(long, value_name = "COUNT", default_value = "1/4")]
    pub storage: TokenCount,
    /// Tokens that a view is drawn from, as a number or a share; all by default
    #[arg(long, value_name = "COUNT")]
    pub render: Option<TokenCount>,
    /// Write the figures as JSON
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
}

/// Compares both precisions, prints the table and writes the JSON.
pub fn run(args: &BenchHalfArgs) -> anyhow::Result<()> {
    let (mut config, overrides) = read_config::<Config>(&args.config, &args.set)?;
    for change in overrides {
        print_note(&change.to_string());
    }
    config.device = args.device.unwrap_or(config.device);
    let options = BenchOptions {
        cases: if args.work.is_empty() { PRECISION_CASES.into() } else { args.work.clone() },
        repeats: args.repeats,
        warmup: args.warmup,
        error: false,
        storage: args.storage,
        render: args.render,
        features: None,
    };
    let report = compare_precision(&config, &options, &*interrupt::flag()?)?;
    print_result(&shown(&report))?;
    if let Some(json) = &args.json {
        crate::output::json::write(&report, json)?;
        print_result(&format!("results: {}", json.display()))?;
    }
    Ok(())
}

const HEADER: [&str; 7] = ["work", "f32", "f16", "f16/f32", "error", "loss f32, f16", "PSNR"];

fn shown(report: &PrecisionReport) -> String {
    let rows: Vec<_> = [HEADER.map(String::from)].into_iter().chain(report.rows.iter().map(cells)).collect();
    let remark = "error: norm of the difference from f32 over its norm, of an update's whole gradient; \
                  PSNR: of an update against its targets, of render against the f32 picture";
    format!("{}\n\n{}\n\n{remark}", report.device, table::columns(&rows))
}

fn cells(row: &PrecisionRow) -> [String; 7] {
    let dash = || "-".to_owned();
    let loss = row.loss.map_or_else(dash, |[single, half]| format!("{single:.6}, {half:.6}"));
    let psnr = match (row.psnr(), row.psnr_to_f32) {
        (Some([single, half]), _) => format!("{single:.3}, {half:.3} dB"),
        (None, Some(psnr)) => format!("{psnr:.1} dB"),
        (None, None) => dash(),
    };
    let [single, half] = [row.f32_s, row.f16_s].map(seconds);
    [row.case.to_string(), single, half, format!("{:.2}", row.ratio), format!("{:.1e}", row.error), loss, psnr]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_has_speed_beside_error() {
        let row = |case, loss, psnr_to_f32| PrecisionRow {
            case,
            f32_s: 0.5,
            f16_s: 0.25,
            ratio: 0.5,
            error: 1.2e-3,
            loss,
            psnr_to_f32,
        };
        let rows = vec![
            row(BenchCase::Encode, None, None),
            row(BenchCase::Render, None, Some(61.25)),
            row(BenchCase::Stage1Step, Some([0.1, 0.1]), None),
        ];
        let expected = "\
flex

work         f32     f16     f16/f32  error   loss f32, f16       PSNR
encode       500 ms  250 ms  0.50     1.2e-3  -                   -
render       500 ms  250 ms  0.50     1.2e-3  -                   61.2 dB
stage1_step  500 ms  250 ms  0.50     1.2e-3  0.100000, 0.100000  10.000, 10.000 dB
";
        let text = shown(&PrecisionReport { device: DeviceName::Flex, rows });
        assert!(text.starts_with(expected), "{text}");
    }
}
