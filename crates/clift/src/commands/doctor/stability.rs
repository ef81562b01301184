//! `clift doctor --stability`.

use std::path::Path;

use anyhow::Context;
use clift_bench::{CaseSize, StabilityRow, outcome_text, run_stability, stability_markdown};
use clift_core::replace_file;
use clift_model::DeviceName;

use crate::output::stdout::{print_note, print_result};

/// Runs every case on every device of the build; fails if an error exceeds its bound.
pub fn run(is_small: bool, markdown: Option<&Path>) -> anyhow::Result<()> {
    let devices: Vec<DeviceName> = DeviceName::ALL.into_iter().filter(|device| device.is_built()).collect();
    let size = if is_small { CaseSize::Small } else { CaseSize::Full };
    let rows = run_stability(&devices, size, &mut |row| print_note(&line(&devices, row)))?;
    if let Some(path) = markdown {
        let text = format!("{}\n{}\n", markdown_head(is_small), stability_markdown(&devices, &rows));
        replace_file(path, text.as_bytes()).with_context(|| format!("writing {}", path.display()))?;
        print_result(&format!("table: {}", path.display()))?;
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

fn markdown_head(small: bool) -> String {
    let command = if small { "clift doctor --stability --small" } else { "clift doctor --stability" };
    format!(
        "# Numbers on hard scenes

Made by `{command} --markdown docs/results/stability.md`, with a column for each device of the
build (`--features ndarray`, `wgpu`); a small version of every case runs in `cargo test --workspace`.

Each case is a real computation in f32, compared with the same code on the same values in f64, which uses the composed
operations instead of the kernels. The error is the largest difference over the largest value; of an update, over its
loss and the gradient of every parameter. A gradient below a thousandth of the largest one is compared with that
thousandth, because a gradient that is zero in exact arithmetic contains only rounding. **Bold** values exceed their
bound. `refused` cases have an error message and a test of their own.
"
    )
}
