//! `clift doctor --stability`: hard cases on every device, each against the same code in f64.
//!
//! A case is a computation of the method: forward, and backward if weights are trained through it. Each case has a bound and
//! the reason for it. The tests run a small version of every case; the full version makes `docs/results/stability.md`.

use clift_model::DeviceName;
use clift_train::TrainError;

use crate::doctor::stability::case::{CaseDevices, CaseSize, StabilityCase, StabilityRow};
use crate::doctor::stability::{attention, clusters, updates};

/// All cases, in the order of the table.
const CASES: [&[StabilityCase]; 3] = [updates::CASES, clusters::CASES, attention::CASES];

/// Runs every case on the devices and passes each finished row to `report`.
pub fn run_stability(
    devices: &[DeviceName],
    size: CaseSize,
    report: &mut dyn FnMut(&StabilityRow),
) -> Result<Vec<StabilityRow>, TrainError> {
    let reference = DeviceName::Flex.open()?;
    let all_devices =
        devices.iter().map(|name| Ok(CaseDevices { device: name.open()?, reference: reference.clone(), size }));
    let all_devices = all_devices.collect::<Result<Vec<_>, TrainError>>()?;
    let rows = CASES.into_iter().flatten().map(|&case| {
        let outcomes =
            all_devices.iter().map(|devices| (case.run)(devices).map_err(|error| error.to_string())).collect();
        let row = StabilityRow { case, outcomes };
        report(&row);
        row
    });
    Ok(rows.collect())
}

/// Formats the table as Markdown.
pub fn stability_markdown(devices: &[DeviceName], rows: &[StabilityRow]) -> String {
    let line = |cells: &[String]| format!("| {} |", cells.join(" | "));
    let mut header: Vec<String> = ["case", "what could break", "bound", "why"].map(String::from).into();
    header.extend(devices.iter().map(|device| format!("`{device}`")));
    let rule = vec!["---".to_owned(); header.len()];
    let body = rows.iter().map(|row| {
        let StabilityCase { name, breaks, bound, reason, .. } = row.case;
        let mut cells: Vec<String> = vec![name.into(), breaks.into(), format!("{bound:.0e}"), reason.into()];
        cells.extend(row.outcomes.iter().map(|outcome| outcome_text(row, outcome)));
        line(&cells)
    });
    let lines: Vec<String> = [line(&header), line(&rule)].into_iter().chain(body).collect();
    lines.join("\n")
}

/// Formats an outcome as a table cell, in bold if it is beyond the bound.
pub fn outcome_text(row: &StabilityRow, outcome: &Result<f64, String>) -> String {
    let text = match outcome {
        Ok(error) => format!("{error:.1e}"),
        Err(reason) => reason.replace(['|', '\n'], " "),
    };
    if outcome.as_ref().is_ok_and(|error| *error <= row.case.bound) { text } else { format!("**{text}**") }
}

#[cfg(test)]
mod tests {
    use super::*;

    const DEVICES: [DeviceName; 2] = [DeviceName::Flex, DeviceName::Ndarray];

    #[test]
    fn small_cases_are_within_bounds_on_cpu_devices() {
        let rows = run_stability(&DEVICES, CaseSize::Small, &mut |_| {}).expect("both devices open");
        let broken: Vec<String> = rows
            .iter()
            .filter(|row| !row.is_within_bound())
            .map(|row| format!("{} (at most {:?}): {:?}", row.case.name, row.case.bound, row.outcomes))
            .collect();
        assert!(broken.is_empty(), "{}", broken.join("\n"));
        // A result in f32 that was compared with itself would be exact.
        let measured = |row: &StabilityRow| row.outcomes.iter().any(|o| matches!(o, Ok(error) if *error > 0.0));
        let exact: Vec<&str> = rows.iter().filter(|row| !measured(row)).map(|row| row.case.name).collect();
        assert!(exact.len() < rows.len() / 2, "{exact:?}");
    }

    #[test]
    fn table_marks_outcomes_beyond_the_bound() {
        let case = StabilityCase { name: "a", breaks: "b", bound: 1e-5, reason: "c", ..CASES[0][0] };
        let outcomes = vec![Ok(2e-6), Ok(f64::NAN), Err("no|way".into())];
        let row = StabilityRow { case, outcomes };
        assert!(!row.is_within_bound());
        let expected = "\
| case | what could break | bound | why | `flex` | `ndarray` | `wgpu` |
| --- | --- | --- | --- | --- | --- | --- |
| a | b | 1e-5 | c | 2.0e-6 | **NaN** | **no way** |";
        assert_eq!(stability_markdown(&DeviceName::ALL, &[row]), expected);
    }
}
