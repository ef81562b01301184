//! `clift bench precision`.

use std::path::PathBuf;

use clift_bench::{PRECISION_CASES, PrecisionReport, PrecisionRow, compare_precision};

use clift_eval::table;

use crate::commands::bench::timing_args::TimingArgs;
use crate::interrupt::{self, Ending};
use crate::output::stdout::print_result;
use crate::output::units::seconds;

#[derive(Debug, clap::Args)]
pub struct BenchPrecisionArgs {
    /// Config file (TOML) with the sizes to time
    pub config: PathBuf,
    #[command(flatten)]
    pub timing: TimingArgs,
}

pub fn run(args: &BenchPrecisionArgs) -> anyhow::Result<()> {
    let timing = &args.timing;
    let config = timing.config.read(&args.config, |_| Ok(()))?;
    let json = timing.json.open_for(&args.config, &config)?;
    let report =
        compare_precision(&config, &timing.options(&PRECISION_CASES), &*interrupt::flag(Ending::WITHOUT_RESULTS)?)?;
    print_result(&report_text(&report))?;
    json.write(&report)
}

fn report_text(report: &PrecisionReport) -> String {
    let reduced = report.precision;
    let (ratio, losses) = (format!("{reduced}/f32"), format!("loss f32, {reduced}"));
    let header = ["case", "f32", reduced.as_str(), &ratio, "error", &losses, "PSNR"];
    let remark = "error: norm of the difference from f32 over the norm of f32, for updates of the whole gradient; \
                  PSNR: of updates against their targets, of render against the f32 image";
    format!("{}\n\n{}\n\n{remark}", report.device, table(header, report.rows.iter().map(cells)))
}

fn cells(row: &PrecisionRow) -> [String; 7] {
    let dash = || "-".to_owned();
    let loss = row.loss.map_or_else(dash, |[f32, reduced]| format!("{f32:.6}, {reduced:.6}"));
    let psnr = match (row.psnr(), row.psnr_to_f32) {
        (Some([f32, reduced]), _) => format!("{f32:.3}, {reduced:.3} dB"),
        (None, Some(psnr)) => format!("{psnr:.1} dB"),
        (None, None) => dash(),
    };
    let [f32_time, reduced_time] = [row.f32_s, row.reduced_s].map(seconds);
    [
        row.case.to_string(),
        f32_time,
        reduced_time,
        format!("{:.2}", row.ratio),
        format!("{:.1e}", row.error),
        loss,
        psnr,
    ]
}

#[cfg(test)]
mod tests {
    use clift_bench::BenchCase;
    use clift_model::{DeviceName, Precision};

    use super::*;

    #[test]
    fn table_has_speed_beside_error() {
        let row = |case, loss, psnr_to_f32| PrecisionRow {
            case,
            f32_s: 0.5,
            reduced_s: 0.25,
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

case         f32     f16     f16/f32  error   loss f32, f16       PSNR
encode       500 ms  250 ms  0.50     1.2e-3  -                   -
render       500 ms  250 ms  0.50     1.2e-3  -                   61.2 dB
stage1_step  500 ms  250 ms  0.50     1.2e-3  0.100000, 0.100000  10.000, 10.000 dB
";
        let text = report_text(&PrecisionReport { device: DeviceName::Flex, precision: Precision::F16, rows });
        assert!(text.starts_with(expected), "{text}");
    }
}
