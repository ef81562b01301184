//! An axis of a plot: range, ticks, and positions of values.

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Scale {
    #[default]
    Linear,
    /// Logarithmic; values are positive.
    Log,
    /// Logarithmic with a tick at every value, for few counts that mostly double.
    LogValues,
}

/// Free share of the range at either end.
const PADDING: f64 = 0.06;

const MAX_TICKS: usize = 7;

/// Smallest distance of ticks as a share of the axis; below it, labels overlap.
const MIN_GAP: f64 = 0.085;

/// A range of values with ticks in it.
#[derive(Clone, Debug, PartialEq)]
pub struct Axis {
    scale: Scale,
    min: f64,
    max: f64,
    ticks: Vec<f64>,
}

impl Axis {
    /// Returns an axis over all values; `None` without a finite (for logarithms: positive) value.
    pub fn new(scale: Scale, values: impl IntoIterator<Item = f64>) -> Option<Self> {
        let is_log = scale != Scale::Linear;
        let mut values: Vec<f64> = values.into_iter().filter(|v| v.is_finite() && (*v > 0.0 || !is_log)).collect();
        values.sort_by(f64::total_cmp);
        values.dedup();
        let along = |value: f64| if is_log { value.ln() } else { value };
        let (low, high) = (along(*values.first()?), along(*values.last()?));
        // A single value is in the middle.
        let padding = if high > low { (high - low) * PADDING } else { (low.abs() * 0.05).max(0.5) };
        let back = |position: f64| if is_log { position.exp() } else { position };
        let mut axis = Self { scale, min: back(low - padding), max: back(high + padding), ticks: Vec::new() };
        axis.ticks = match scale {
            Scale::Linear => linear_ticks(axis.min, axis.max),
            Scale::Log => log_ticks(axis.min, axis.max),
            Scale::LogValues => values,
        };
        axis.thin();
        Some(axis)
    }

    /// Returns the position of a value: 0 at the start of the axis, 1 at the end.
    pub fn position(&self, value: f64) -> f64 {
        let along = |value: f64| if self.scale == Scale::Linear { value } else { value.ln() };
        (along(value) - along(self.min)) / (along(self.max) - along(self.min))
    }

    pub fn ticks(&self) -> impl Iterator<Item = (f64, String)> {
        // Enough decimals to distinguish neighbours.
        let step = self.ticks.windows(2).map(|pair| pair[1] - pair[0]).fold(f64::INFINITY, f64::min);
        let step = if step.is_finite() { step } else { self.ticks.first().map_or(1.0, |tick| tick.abs()) };
        let decimals = if step > 0.0 { (-(step * 1.000_001).log10()).ceil().max(0.0) as usize } else { 0 };
        self.ticks.iter().map(move |&tick| (tick, grouped(tick, decimals)))
    }

    fn thin(&mut self) {
        let mut kept: Vec<f64> = Vec::new();
        for &tick in &self.ticks {
            if kept.last().is_none_or(|&last| self.position(tick) - self.position(last) >= MIN_GAP) {
                kept.push(tick);
            }
        }
        self.ticks = kept;
    }
}

/// Returns the multiples of 1, 2 or 5 times a power of ten within a range, at most [`MAX_TICKS`].
fn linear_ticks(min: f64, max: f64) -> Vec<f64> {
    let least = (max - min) / MAX_TICKS as f64;
    let power = 10_f64.powf(least.log10().floor());
    let steps = [1.0, 2.0, 5.0, 10.0].map(|factor| factor * power);
    let step = steps.into_iter().find(|step| *step >= least).unwrap_or(10.0 * power);
    let (first, last) = ((min / step).ceil() as i64, (max / step).floor() as i64);
    // Quotients for steps below 1: 3 * 0.1 is not 0.3.
    let tick = |i: i64| if step < 1.0 { i as f64 / (1.0 / step).round() } else { i as f64 * step };
    (first..=last).map(tick).collect()
}

/// Returns the powers of ten within a range, with their multiples by 2 and 5 or by 3 where at most [`MAX_TICKS`] result.
/// A range with fewer than three such ticks gets linear ticks.
fn log_ticks(min: f64, max: f64) -> Vec<f64> {
    let powers = min.log10().floor() as i32..=max.log10().ceil() as i32;
    for factors in [&[1.0, 2.0, 5.0][..], &[1.0, 3.0], &[1.0]] {
        let ticks = powers.clone().flat_map(|power| factors.iter().map(move |factor| factor * 10_f64.powi(power)));
        let ticks: Vec<f64> = ticks.filter(|tick| (min..=max).contains(tick)).collect();
        if (3..=MAX_TICKS).contains(&ticks.len()) {
            return ticks;
        }
    }
    linear_ticks(min, max)
}

/// Formats seconds as milliseconds, with three digits below 1,000 ms.
pub fn milliseconds(seconds: f64) -> String {
    let ms = seconds * 1e3;
    grouped(ms, if ms < 9.995 { 2 } else { usize::from(ms < 99.95) })
}

/// Formats a number with a comma between thousands.
pub fn grouped(value: f64, decimals: usize) -> String {
    let text = format!("{:.decimals$}", value.abs());
    let (whole, fraction) = text.split_once('.').map_or((text.as_str(), None), |(a, b)| (a, Some(b)));
    let mut grouped = if value < 0.0 { "\u{2212}".to_owned() } else { String::new() };
    for (i, digit) in whole.chars().enumerate() {
        if i > 0 && (whole.len() - i) % 3 == 0 {
            grouped.push(',');
        }
        grouped.push(digit);
    }
    if let Some(fraction) = fraction {
        grouped.push('.');
        grouped.push_str(fraction);
    }
    grouped
}

#[cfg(test)]
mod tests {
    use super::*;

    fn labels(scale: Scale, values: &[f64]) -> Vec<String> {
        Axis::new(scale, values.iter().copied()).unwrap().ticks().map(|(_, label)| label).collect()
    }

    #[test]
    fn ticks_are_round_numbers_or_counts() {
        assert_eq!(labels(Scale::Linear, &[14.2, 18.1]), ["14", "15", "16", "17", "18"]);
        assert_eq!(labels(Scale::Linear, &[0.31, 0.52]), ["0.30", "0.35", "0.40", "0.45", "0.50"]);
        assert_eq!(labels(Scale::Linear, &[-3.0, 3.0]), ["\u{2212}3", "\u{2212}2", "\u{2212}1", "0", "1", "2", "3"]);
        assert_eq!(
            labels(Scale::Linear, &[0.0, 12_000.0]),
            ["0", "2,000", "4,000", "6,000", "8,000", "10,000", "12,000"]
        );
        assert_eq!(labels(Scale::Log, &[7.0, 90.0]), ["10", "20", "50", "100"]);
        assert_eq!(labels(Scale::Log, &[0.5, 2000.0]), ["1", "10", "100", "1,000"]);
        assert_eq!(labels(Scale::Log, &[0.011, 0.12]), ["0.01", "0.02", "0.05", "0.10"]);
        // No power of ten in the range: linear ticks.
        let expected = ["11.0", "11.5", "12.0", "12.5", "13.0", "13.5", "14.0"];
        assert_eq!(labels(Scale::Log, &[11.0, 14.0]), expected);
        assert_eq!(labels(Scale::LogValues, &[8.0, 64.0, 16.0, 32.0, 8.0]), ["8", "16", "32", "64"]);
        assert_eq!(labels(Scale::LogValues, &[4096.0, 256.0, 260.0]), ["256", "4,096"]);
    }

    #[test]
    fn values_have_ordered_positions_within_the_axis() {
        for scale in [Scale::Linear, Scale::Log, Scale::LogValues] {
            let axis = Axis::new(scale, [3.0, 50.0, 7.0]).unwrap();
            let positions = [3.0, 7.0, 50.0].map(|value| axis.position(value));
            assert!(positions[0] > 0.0 && positions.is_sorted() && positions[2] < 1.0, "{positions:?}");
            assert!(axis.ticks().all(|(tick, _)| (0.0..=1.0).contains(&axis.position(tick))));
        }
        for scale in [Scale::Linear, Scale::LogValues] {
            let position = Axis::new(scale, [8.0, 8.0]).unwrap().position(8.0);
            assert!((position - 0.5).abs() < 1e-12, "{position}");
        }
        assert_eq!(Axis::new(Scale::Linear, []), None);
        assert_eq!(Axis::new(Scale::Linear, [f64::NAN, f64::INFINITY]), None);
        assert_eq!(Axis::new(Scale::Log, [0.0, -1.0]), None);
    }

    #[test]
    fn thousands_are_grouped() {
        assert_eq!([0.0, 999.0, 1000.0, 1_234_567.0].map(|v| grouped(v, 0)), ["0", "999", "1,000", "1,234,567"]);
        assert_eq!([0.000_512, 0.0123, 0.4567, 3.2].map(milliseconds), ["0.51", "12.3", "457", "3,200"]);
        assert_eq!(grouped(-1234.56, 1), "\u{2212}1,234.6");
    }
}
