//! `clift doctor --stability`.

use clift_bench::{CaseSize, StabilityRow, catch_panic, outcome_text, run_stability, stability_markdown};
use clift_model::DeviceName;

use crate::output::stdout::{print_note, print_result};

/// Runs every case on every device of the build that this machine has, and prints a Markdown table; fails if an error exceeds
/// its bound.
pub fn run() -> anyhow::Result<()> {
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
    print_result(&format!("{HEAD}\n{}", stability_markdown(&devices, &rows)))?;
    let failed = rows.iter().filter(|row| !row.is_within_bound()).count();
    anyhow::ensure!(failed == 0, "{failed} of {} cases exceed their bound", rows.len());
    Ok(())
}

fn line(devices: &[DeviceName], row: &StabilityRow) -> String {
    let outcomes = devices.iter().zip(&row.outcomes);
    let outcomes = outcomes.map(|(device, outcome)| format!("{device} {}", outcome_text(row, outcome)));
    format!("{}: {}", row.case.name, outcomes.collect::<Vec<_>>().join(", "))
}

const HEAD: &str = "# Numbers on hard scenes

Made by `clift doctor --stability > docs/results/stability.md`, with a column for each device of the
build (`--features ndarray`, `wgpu` or `wgsl`); a small version of every case runs in `cargo test --workspace`.

Each case is a real computation in f32, compared with the same code on the same values in f64, which uses the composed
operations instead of the kernels. The error is the largest difference over the largest value; of an update, over its
loss and the gradient of every parameter. A gradient below a thousandth of the largest one is compared with that
thousandth, because a gradient that is zero in exact arithmetic contains only rounding. **Bold** values exceed their
bound.
";
