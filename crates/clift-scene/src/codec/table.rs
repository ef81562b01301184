//! Probabilities of the quantized coefficients of a direction.
//!
//! Encoder and decoder must find the same integers on every machine: the table takes sums, products, quotients and
//! comparisons of 64-bit floats only, which IEEE 754 defines to the last bit.

use crate::codec::entropy::{Decoder, Encoder, Interval, TOTAL};

/// Standard deviations that levels of the table cover; values beyond are escaped.
const RANGE: f64 = 8.0;
const MAX_LEVEL: i32 = 1023;
/// Least probability of an escape, of [`TOTAL`]. No symbol is more probable than the rest, `1 - 2^-10`, so a stream has
/// at least [`MIN_BITS`] per value, which bounds the memory that a small file can claim.
const MIN_ESCAPE: u32 = 64;
/// Fewest bits of a value in a stream: `-log2(1 - 2^-10)`, rounded down.
pub(crate) const MIN_BITS: f64 = 1.4e-3;
/// Largest number of bits of an escaped magnitude.
const MAX_ESCAPE_BITS: u32 = 30;

/// Symbols of a direction: the levels `-levels..=levels`, then the escape.
#[derive(Clone, Debug, Default)]
pub(crate) struct Table {
    levels: i32,
    /// First quantile of every symbol, and [`TOTAL`].
    starts: Vec<u32>,
}

impl Table {
    /// Makes the table of a direction with a distribution and a step in standard deviations, `ratio`.
    pub fn new(knots: &[f32], cumulative: &[f32], ratio: f64) -> Self {
        let levels = (RANGE / ratio + 0.5).floor().min(f64::from(MAX_LEVEL)) as i32;
        let free = f64::from(TOTAL - MIN_ESCAPE - (2 * levels as u32 + 1));
        let mut starts = Vec::with_capacity(2 * levels as usize + 3);
        starts.push(0);
        let (mut start, mut knot) = (0, 0);
        let mut below = |x: f64| {
            while knot < knots.len() && f64::from(knots[knot]) <= x {
                knot += 1;
            }
            match knot {
                0 => 0.0,
                k if k == knots.len() => 1.0,
                k => {
                    let [x0, x1, p0, p1] = [knots[k - 1], knots[k], cumulative[k - 1], cumulative[k]].map(f64::from);
                    p0 + (p1 - p0) * ((x - x0) / (x1 - x0))
                }
            }
        };
        let mut left = below((f64::from(-levels) - 0.5) * ratio);
        for level in -levels..=levels {
            let right = below((f64::from(level) + 0.5) * ratio);
            start += 1 + ((right - left) * free).floor() as u32;
            starts.push(start);
            left = right;
        }
        starts.push(TOTAL);
        Self { levels, starts }
    }

    fn interval(&self, symbol: usize) -> Interval {
        Interval { start: self.starts[symbol], size: self.starts[symbol + 1] - self.starts[symbol] }
    }

    fn escape(&self) -> usize {
        self.starts.len() - 2
    }

    /// Returns the symbol of a level; `None` for a level beyond the table.
    fn symbol(&self, level: i32) -> Option<usize> {
        (level.abs() <= self.levels).then(|| (level + self.levels) as usize)
    }

    pub fn bits(&self, level: i32) -> f32 {
        let bits = |symbol| 16.0 - (self.interval(symbol).size as f32).log2();
        match self.symbol(level) {
            Some(symbol) => bits(symbol),
            None => bits(self.escape()) + 2.0 * (32 - self.beyond(level).leading_zeros()) as f32,
        }
    }

    /// Returns how far a level lies beyond the table, at least 1.
    fn beyond(&self, level: i32) -> u32 {
        level.unsigned_abs() - self.levels as u32
    }

    /// Adds a level. A level beyond the table is an escape, its sign, and how far it lies beyond in an Exp-Golomb code: the
    /// number of bits less one in unary, and the bits after the first.
    pub fn encode(&self, level: i32, encoder: &mut Encoder) {
        if let Some(symbol) = self.symbol(level) {
            encoder.push(self.interval(symbol));
            return;
        }
        encoder.push(self.interval(self.escape()));
        let beyond = self.beyond(level);
        let count = beyond.ilog2();
        encoder.push_bits(u32::from(level < 0), 1);
        encoder.push_bits((1 << (count + 1)) - 2, count + 1);
        encoder.push_bits(beyond, count);
    }

    /// Decodes a level; `None` for an escape that no encoder writes.
    #[inline]
    pub fn decode(&self, decoder: &mut Decoder) -> Option<i32> {
        let zero = self.levels as usize;
        let (zero_start, zero_end) = (self.starts[zero], self.starts[zero + 1]);
        let symbol = decoder.next(|quantile| {
            if (zero_start..zero_end).contains(&quantile) {
                return (zero, Interval { start: zero_start, size: zero_end - zero_start });
            }
            let symbol = self.starts.partition_point(|start| *start <= quantile) - 1;
            (symbol, self.interval(symbol))
        });
        if symbol != self.escape() {
            return Some(symbol as i32 - self.levels);
        }
        let is_negative = decoder.next_bit();
        let mut count = 0;
        while decoder.next_bit() {
            count += 1;
            if count > MAX_ESCAPE_BITS {
                return None;
            }
        }
        let beyond = 1_i64 << count | i64::from(decoder.next_bits(count));
        let level = i32::try_from(beyond + i64::from(self.levels)).ok()?;
        Some(if is_negative { -level } else { level })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A distribution with half of its values within a tenth of a standard deviation.
    const KNOTS: [f32; 4] = [-4.0, -0.1, 0.1, 4.0];
    const CUMULATIVE: [f32; 4] = [0.0, 0.25, 0.75, 1.0];

    #[test]
    fn probabilities_are_those_of_the_distribution() {
        let table = Table::new(&KNOTS, &CUMULATIVE, 1.0);
        assert_eq!((table.levels, table.starts.len()), (8, 19));
        let share = |level| f64::from(table.interval(table.symbol(level).unwrap()).size) / f64::from(TOTAL);
        // Half, and twice 0.4 of 3.9 deviations with a quarter of the values.
        assert!((share(0) - (0.5 + 0.5 * 0.4 / 3.9)).abs() < 1e-2, "{}", share(0));
        assert!((share(3) - 0.25 / 3.9).abs() < 1e-2 && share(8) > 0.0);
        assert!(table.interval(table.escape()).size >= MIN_ESCAPE);
        assert!((f64::from(table.bits(3)) + share(3).log2()).abs() < 1e-5);
        assert_eq!(Table::new(&KNOTS, &CUMULATIVE, 1e9).levels, 0);
        assert_eq!(Table::new(&KNOTS, &CUMULATIVE, 1e-9).levels, MAX_LEVEL);
        let sure = Table::new(&[-1.0, 1.0], &[0.0, 1.0], 1e9);
        assert!(f64::from(sure.bits(0)) > MIN_BITS, "{}", sure.bits(0));
    }

    #[test]
    fn escapes_beyond_all_levels_are_refused() {
        let table = Table::new(&KNOTS, &CUMULATIVE, 1.0);
        for (ones, expected) in [(30, true), (31, false), (60, false)] {
            let mut encoder = Encoder::default();
            encoder.push(table.interval(table.escape()));
            encoder.push_bits(0, 1);
            (0..ones).for_each(|_| encoder.push_bits(1, 1));
            encoder.push_bits(0, 31);
            let mut decoder = Decoder::new(encoder.finish()).unwrap();
            assert_eq!(table.decode(&mut decoder).is_some(), expected, "{ones}");
        }
    }
}
