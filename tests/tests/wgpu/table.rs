//! The rows of the comparison: an operation, its tolerance with the reason, its error.

use std::time::Duration;

use crate::place::Place;

pub struct Case {
    pub operation: &'static str,
    pub tolerance: Tolerance,
    /// Runs the operation on a device, always with the same inputs.
    pub run: fn(&Place) -> Values,
}

/// Largest relative differences between two devices.
#[derive(Clone, Copy)]
pub struct Tolerance {
    /// Difference of results over the largest result.
    forward: f64,
    /// Difference of gradients, each tensor over its own largest entry; `None` without gradients.
    backward: Option<f64>,
    reason: &'static str,
}

impl Tolerance {
    pub const fn forward(forward: f64, reason: &'static str) -> Self {
        Self { forward, backward: None, reason }
    }

    pub const fn both(forward: f64, backward: f64, reason: &'static str) -> Self {
        Self { forward, backward: Some(backward), reason }
    }

    pub const fn because(self, reason: &'static str) -> Self {
        Self { reason, ..self }
    }

    pub const fn case(self, operation: &'static str, run: fn(&Place) -> Values) -> Case {
        Case { operation, tolerance: self, run }
    }
}

pub type Named = Vec<(String, Vec<f64>)>;

#[derive(Default)]
pub struct Values {
    pub forward: Named,
    pub backward: Named,
}

/// Relative differences between two devices.
#[derive(Debug)]
pub struct Difference {
    forward: Worst,
    backward: Worst,
}

#[derive(Debug, Default)]
struct Worst {
    error: f64,
    name: String,
}

/// Smallest scale of a gradient, as a share of the largest of all: gradients that are zero in exact arithmetic, such as
/// those of a constant added to every score of a softmax, consist of rounding.
const SMALLEST_SCALE: f64 = 1e-3;

impl Difference {
    pub fn of(got: &Values, expected: &Values) -> Self {
        Self {
            forward: Worst::of(&got.forward, &expected.forward, 0.0),
            backward: Worst::of(&got.backward, &expected.backward, SMALLEST_SCALE),
        }
    }

    pub fn is_zero(&self) -> bool {
        self.forward.error == 0.0 && self.backward.error == 0.0
    }
}

impl Worst {
    fn of(got: &Named, expected: &Named, smallest_scale: f64) -> Self {
        assert_eq!(got.len(), expected.len(), "both devices give the same tensors");
        let largest = |values: &[f64]| values.iter().fold(0.0_f64, |most, value| most.max(value.abs()));
        let floor = smallest_scale * expected.iter().map(|(_, values)| largest(values)).fold(0.0, f64::max);
        let errors = got.iter().zip(expected).map(|((name, got), (expected_name, expected))| {
            assert_eq!((name, got.len()), (expected_name, expected.len()), "name and length of a tensor");
            let apart = got.iter().zip(expected).map(|(a, b)| (a - b).abs());
            // `f64::max` would ignore NaN.
            let apart = apart.fold(0.0, |most, value| if value > most || value.is_nan() { value } else { most });
            let error = if apart == 0.0 { 0.0 } else { apart / largest(expected).max(floor) };
            Self { error, name: name.clone() }
        });
        errors.fold(
            Self::default(),
            |worst, next| if next.error > worst.error || next.error.is_nan() { next } else { worst },
        )
    }

    fn is_within(&self, tolerance: f64) -> bool {
        // False for NaN.
        self.error <= tolerance
    }
}

pub fn header() -> &'static str {
    "| operation | forward | at most | backward | at most | seconds | why |\n|---|---|---|---|---|---|---|"
}

impl Case {
    pub fn row(&self, difference: &Difference, elapsed: Duration) -> String {
        let Tolerance { forward, backward, reason } = self.tolerance;
        let backward = match backward {
            Some(tolerance) => format!("{} | {tolerance:.0e}", shown(difference.backward.error)),
            None => "- | -".into(),
        };
        let forward = format!("{} | {}", shown(difference.forward.error), shown_bound(forward));
        let seconds = elapsed.as_secs_f64();
        format!("| {} | {forward} | {backward} | {seconds:.1} | {reason} |", self.operation)
    }

    pub fn complaints(&self, difference: &Difference) -> Vec<String> {
        let directions = [
            ("result", &difference.forward, Some(self.tolerance.forward)),
            ("gradient", &difference.backward, self.tolerance.backward),
        ];
        let too_far = directions.into_iter().filter_map(|(what, worst, tolerance)| {
            let tolerance = tolerance?;
            let Worst { error, name } = worst;
            (!worst.is_within(tolerance)).then(|| {
                format!("{}: the {what} `{name}` is off by {error:.1e}, more than {tolerance:.0e}", self.operation)
            })
        });
        too_far.collect()
    }

    pub fn num_directions(&self) -> usize {
        1 + usize::from(self.tolerance.backward.is_some())
    }
}

fn shown(error: f64) -> String {
    if error == 0.0 { "0".into() } else { format!("{error:.1e}") }
}

fn shown_bound(tolerance: f64) -> String {
    if tolerance == 0.0 { "0".into() } else { format!("{tolerance:.0e}") }
}
