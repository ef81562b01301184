//! Seconds, rates, bytes and counts as text.

use indicatif::{BinaryBytes, DecimalBytes};

/// Formats seconds with three significant digits: `12.3 ms`, `1.00 s`, `123 s`.
pub fn seconds(seconds: f64) -> String {
    match seconds {
        s if s >= 100.0 => format!("{s:.0} s"),
        s if s >= 10.0 => format!("{s:.1} s"),
        s if s >= 1.0 => format!("{s:.2} s"),
        s if s >= 0.1 => format!("{:.0} ms", s * 1e3),
        s if s >= 0.01 => format!("{:.1} ms", s * 1e3),
        s => format!("{:.2} ms", s * 1e3),
    }
}

/// Formats a duration in its two largest units: `59 s`, `1 min 1 s`, `7 h 45 min`, `2 d 12 h`.
pub fn duration(seconds: f64) -> String {
    let total = seconds.max(0.0).round() as u64;
    match (total / 86_400, total / 3600 % 24, total / 60 % 60, total % 60) {
        (0, 0, 0, s) => format!("{s} s"),
        (0, 0, min, s) => format!("{min} min {s} s"),
        (0, h, min, _) => format!("{h} h {min} min"),
        (d, h, ..) => format!("{d} d {h} h"),
    }
}

/// Formats a rate per second, below 1 as seconds per item: `12.3/s`, `2.5 s each`.
pub fn rate(per_s: f64) -> String {
    if per_s >= 1.0 { format!("{per_s:.1}/s") } else { format!("{:.1} s each", 1.0 / per_s) }
}

/// Formats an amount of memory: `700.00 MiB`.
pub fn memory_size(bytes: u64) -> String {
    BinaryBytes(bytes).to_string()
}

/// Formats the size of a file with decimal prefixes: `999 B`, `23.46 MB`.
pub fn file_size(bytes: u64) -> String {
    DecimalBytes(bytes).to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_formatted_with_fitting_units() {
        let durations = [0.4, 59.0, 61.0, 3600.0 * 7.75, 86_400.0 * 2.5].map(duration);
        assert_eq!(durations, ["0 s", "59 s", "1 min 1 s", "7 h 45 min", "2 d 12 h"]);
        assert_eq!([12.34, 1.0, 0.4].map(rate), ["12.3/s", "1.0/s", "2.5 s each"]);
    }
}
