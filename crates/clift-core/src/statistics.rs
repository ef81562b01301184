//! Summary statistics of samples.

use std::fmt;

use serde::Serialize;

/// Returns the median: the mean of the two middle values for an even count, NaN for no values.
pub fn median(values: &[f64]) -> f64 {
    let sorted = sorted(values);
    let middle = sorted.len() / 2;
    match sorted.len() {
        0 => f64::NAN,
        count if count.is_multiple_of(2) => f64::midpoint(sorted[middle - 1], sorted[middle]),
        _ => sorted[middle],
    }
}

/// Returns the mean, summed in the given order; `None` for no values.
pub fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// Returns the standard error of the mean: the sample standard deviation over the square root of the count. `None` for
/// fewer than two values.
pub fn standard_error(values: &[f64]) -> Option<f64> {
    let count = values.len() as f64;
    let mean = mean(values)?;
    let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    (values.len() > 1).then(|| (squares / (count - 1.0) / count).sqrt())
}

/// Returns the smallest value that 95 % of the values do not exceed (nearest rank): the largest of fewer than 20
/// values, NaN for no values.
pub fn p95(values: &[f64]) -> f64 {
    let sorted = sorted(values);
    // Integer arithmetic: 0.95 * 20 exceeds 19 in binary.
    let rank = (sorted.len() * 95).div_ceil(100);
    rank.checked_sub(1).map_or(f64::NAN, |index| sorted[index])
}

/// Returns the first and the third quartile, interpolated linearly between neighbouring values; `None` for no values.
pub fn quartiles(values: &[f64]) -> Option<[f64; 2]> {
    let sorted = sorted(values);
    let last = sorted.len().checked_sub(1)?;
    Some([0.25, 0.75].map(|share| {
        let position = share * last as f64;
        let below = position.floor() as usize;
        let above = (below + 1).min(last);
        sorted[below] + (sorted[above] - sorted[below]) * (position - below as f64)
    }))
}

/// Smallest value, median and largest value. Prints as `1.0 / 2.5 / 4.0`, with the precision of the format string.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct MinMedianMax {
    /// Smallest value.
    pub min: f64,
    /// Median, as [`median`].
    pub median: f64,
    /// Largest value.
    pub max: f64,
}

impl MinMedianMax {
    /// Summarises the values; `None` for no values.
    pub fn of(values: &[f64]) -> Option<Self> {
        let sorted = sorted(values);
        Some(Self { min: *sorted.first()?, median: median(values), max: *sorted.last()? })
    }
}

impl fmt::Display for MinMedianMax {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let digits = f.precision().unwrap_or(0);
        let Self { min, median, max } = self;
        write!(f, "{min:.digits$} / {median:.digits$} / {max:.digits$}")
    }
}

fn sorted(values: &[f64]) -> Vec<f64> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn statistics_of_few_and_no_values_are_those_by_hand() {
        for (values, middle) in [(&[3.0, 1.0, 2.0][..], 2.0), (&[4.0, 1.0, 3.0, 2.0], 2.5), (&[7.0], 7.0)] {
            assert_eq!(median(values), middle);
        }
        let values = |count: u32| (1..=count).rev().map(f64::from).collect::<Vec<_>>();
        for (count, expected) in [(1, 1.0), (5, 5.0), (19, 19.0), (20, 19.0), (21, 20.0), (100, 95.0), (101, 96.0)] {
            assert_eq!(p95(&values(count)), expected, "of {count}");
        }
        assert!(p95(&[]).is_nan() && median(&[]).is_nan());
        assert_eq!(quartiles(&[5.0, 1.0, 3.0, 2.0, 4.0]), Some([2.0, 4.0]));
        assert_eq!(quartiles(&[4.0, 1.0, 2.0, 3.0]), Some([1.75, 3.25]));
        assert_eq!((quartiles(&[7.0]), quartiles(&[])), (Some([7.0; 2]), None));
        // Deviation sqrt(32), over sqrt(2).
        assert_eq!((mean(&[22.0, 30.0]), standard_error(&[22.0, 30.0])), (Some(26.0), Some(4.0)));
        assert_eq!((mean(&[]), standard_error(&[]), standard_error(&[1.0])), (None, None, None));
        let summary = MinMedianMax::of(&[4.0, 1.0, 2.0, 8.0]).unwrap();
        assert_eq!((format!("{summary:.1}"), MinMedianMax::of(&[])), ("1.0 / 3.0 / 8.0".into(), None));
    }
}
