//! `clift doctor --stability`.

use clift_bench::{CaseSize, StabilityRow, catch_panic, outcome_text, run_stability, stability_markdown};
use clift_model::DeviceName;

use crate::output::output_file::OutputFile;
use crate::output::stdout::{print_note, print_result};

/// Runs every case on every device of the build that this machine has; fails if an error exceeds its bound.
pub fn run(markdown: Option<&OutputFile>) -> anyhow::Result<()> {
    let opens = |device: &DeviceName| {
        let opened = catch_panic(|| device.open()).map(|opened| opened.map(drop).map_err(|error| error.to_string()));
        let reason = opened.and_then(|opened| opened).err();
        if let Some(reason) = &reason {
            print_note(&format!("{device} is not measured: {reason}"));
        }
        reason.is_none()
    };
    let devices: Vec<DeviceName> = DeviceName::ALL.into_iter().filter(|name| name.is_built()).filter(opens).collect();
    let rows = run_stability(&devices, CaseSize::Full, &mut |row| print_note(&line(&devices, row)))?;
    if let Some(file) = markdown {
        let text = format!("{}\n{}\n", MARKDOWN_HEAD, stability_markdown(&devices, &rows));
        file.write(text.as_bytes())?;
        print_result(&format!("table: {}", file.path().display()))?;
    }
    let failed = rows.iter().filter(|row| !row.is_within_bound()).count();
    print_result(&format!("{} of {} cases within bounds on {}", rows.len() - failed, rows.len(), names(&devices)))?;
    anyhow::ensure!(failed == 0, "{failed} cases exceed their bound");
    Ok(())
}

fn names(devices: &[DeviceName]) -> String {
    devices.iter().map(ToString::to_string).collect::<Vec<_>>().join(" and ")
}

fn line(devices: &[DeviceName], row: &StabilityRow) -> String {
    let outcomes = devices.iter().zip(&row.outcomes);
    let outcomes = outcomes.map(|(device, outcome)| format!("{device} {}", outcome_text(row, outcome)));
    format!("{}: {}", row.case.name, outcomes.collect::<Vec<_>>().join(", "))
}

const MARKDOWN_HEAD: &str = "# Numbers on hard scenes

Made by `clift doctor --stability --markdown docs/results/stability.md --force`, with a column for each device of the
build (`--features ndarray`, `wgpu`); a small version of every case runs in `cargo test --workspace`.

Each case is a real computation in f32, compared with the same code on the same values in f64, which uses the composed
operations instead of the kernels. The error is the largest difference over the largest value; of an update, over its
loss and the gradient of every parameter. A gradient below a thousandth of the largest one is compared with that
thousandth, because a gradient that is zero in exact arithmetic contains only rounding. **Bold** values exceed their
bound.
";
