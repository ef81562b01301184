//! `clift doctor --stability`: hard cases on every device, each against the same code in f64.
//!
//! A case is a real computation, forward and, where weights learn from it, backward. Its bound stands beside it with
//! the reason; a small version of every case runs in the tests, the full one makes `docs/results/stability.md`.

use clift_model::DeviceName;
use clift_train::TrainError;

use crate::doctor::stability::case::{Bound, Case, CaseDevices, Outcome, Row, Size};

/// Runs every case on the devices; `tell` is given every row as it is done.
///
/// # Errors
/// A device that cannot be opened.
pub fn run(devices: &[DeviceName], size: Size, tell: &mut dyn FnMut(&Row)) -> Result<Vec<Row>, TrainError> {
    let reference = DeviceName::Flex.open()?;
    let places =
        devices.iter().map(|name| Ok(CaseDevices { device: name.open()?, reference: reference.clone(), size }));
    let places = places.collect::<Result<Vec<_>, TrainError>>()?;
    let rows = Case::all().map(|case| {
        let outcomes = places.iter().map(|place| case.run(place).map_err(|error| error.to_string())).collect();
        let row = Row { case, outcomes };
        tell(&row);
        row
    });
    Ok(rows.collect())
}

/// The table as Markdown.
pub fn markdown(devices: &[DeviceName], rows: &[Row]) -> String {
    let line = |cells: &[String]| format!("| {} |", cells.join(" | "));
    let mut header: Vec<String> = ["case", "what could break", "bound", "why"].map(String::from).into();
    header.extend(devices.iter().map(|device| format!("`{device}`")));
    let rule = vec!["---".to_owned(); header.len()];
    let body = rows.iter().map(|row| {
        let Case { name, breaks, bound, reason, .. } = row.case;
        let bound = match bound {
            Bound::Most(most) => format!("{most:.0e}"),
            Bound::Refused(_) => "refused".into(),
        };
        let mut cells: Vec<String> = vec![name.into(), breaks.into(), bound, reason.into()];
        cells.extend(row.outcomes.iter().map(|outcome| table_text(row, outcome)));
        line(&cells)
    });
    let lines: Vec<String> = [line(&header), line(&rule)].into_iter().chain(body).collect();
    lines.join("\n")
}

/// An outcome in a cell; what does not hold stands out.
pub fn table_text(row: &Row, outcome: &Result<Outcome, String>) -> String {
    let text = match outcome {
        Ok(Outcome::Error(error)) => format!("{error:.1e}"),
        Ok(Outcome::Refused(_)) => "refused".into(),
        Err(reason) => reason.replace(['|', '\n'], " "),
    };
    if outcome.as_ref().is_ok_and(|outcome| row.case.holds(outcome)) { text } else { format!("**{text}**") }
}

#[cfg(test)]
mod tests {
    use super::*;

    const DEVICES: [DeviceName; 2] = [DeviceName::Flex, DeviceName::Ndarray];

    #[test]
    fn every_case_holds_at_its_small_size_on_every_cpu_device() {
        let rows = run(&DEVICES, Size::Small, &mut |_| {}).expect("both devices open");
        let broken: Vec<String> = rows
            .iter()
            .filter(|row| !row.holds())
            .map(|row| format!("{} (at most {:?}): {:?}", row.case.name, row.case.bound, row.outcomes))
            .collect();
        assert!(broken.is_empty(), "{}", broken.join("\n"));
        // A result in f32 that was compared with itself would be exact.
        let measured = |row: &Row| row.outcomes.iter().any(|o| matches!(o, Ok(Outcome::Error(error)) if *error > 0.0));
        let exact: Vec<&str> = rows.iter().filter(|row| !measured(row)).map(|row| row.case.name).collect();
        assert!(exact.len() < rows.len() / 2, "{exact:?}");
    }

    #[test]
    fn the_table_marks_what_does_not_hold() {
        let case = Case::all().next().expect("there are cases");
        let case = Case { name: "a", breaks: "b", bound: Bound::Most(1e-5), reason: "c", ..case };
        let outcomes = vec![Ok(Outcome::Error(2e-6)), Ok(Outcome::Error(f64::NAN)), Err("no|way".into())];
        let row = Row { case, outcomes };
        assert!(!row.holds());
        let expected = "\
| case | what could break | bound | why | `flex` | `ndarray` | `wgpu` |
| --- | --- | --- | --- | --- | --- | --- |
| a | b | 1e-5 | c | 2.0e-6 | **NaN** | **no way** |";
        assert_eq!(markdown(&DeviceName::ALL, &[row]), expected);
    }
}
