//! Numbers for people.

/// Writes a number of bytes in the unit that suits it.
pub fn bytes(count: u64) -> String {
    let units = ["bytes", "kB", "MB", "GB", "TB"];
    let mut value = count as f64;
    let mut unit = 0;
    while value >= 999.5 && unit + 1 < units.len() {
        value /= 1000.0;
        unit += 1;
    }
    if unit == 0 { format!("{count} bytes") } else { format!("{value:.1} {}", units[unit]) }
}

/// Writes a count with its noun: `1 scene`, `2 scenes`.
pub fn count(count: usize, noun: &str) -> String {
    format!("{count} {noun}{}", if count == 1 { "" } else { "s" })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_are_written_in_the_unit_that_suits_them_and_nouns_follow_their_count() {
        assert_eq!(
            [0, 999, 1000, 999_960, 23_456_789].map(bytes),
            ["0 bytes", "999 bytes", "1.0 kB", "1.0 MB", "23.5 MB"]
        );
        assert_eq!([1, 2, 0].map(|n| count(n, "scene")), ["1 scene", "2 scenes", "0 scenes"]);
    }
}
