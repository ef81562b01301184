//! A stream of symbols with 16-bit probabilities, by asymmetric numeral systems (Duda, 2013): 64 bits of state, words of 32
//! bits. `docs/reference/files.md` has the decoder.
// N patches of the context views, S tokens

use std::borrow::Borrow;
use std::num::NonZeroU32;

use constriction::stream::model::{DecoderModel, EncoderModel, EntropyModel};
use constriction::stream::stack::AnsCoder;
use constriction::stream::{Decode, Encode};

const PRECISION: usize = 16;
/// The probabilities of all symbols sum to `TOTAL`.
pub(crate) const TOTAL: u32 = 1 << PRECISION;

/// Share of a symbol: the quantiles `start..start + size` of `0..TOTAL`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Interval {
    pub start: u32,
    pub size: u32,
}

impl Interval {
    fn parts(self) -> (u32, NonZeroU32) {
        (self.start, NonZeroU32::new(self.size).expect("no symbol has probability 0"))
    }
}

impl EntropyModel<PRECISION> for Interval {
    type Symbol = ();
    type Probability = u32;
}

impl EncoderModel<PRECISION> for Interval {
    fn left_cumulative_and_probability(&self, _: impl Borrow<()>) -> Option<(u32, NonZeroU32)> {
        Some(self.parts())
    }
}

struct Lookup<F>(F);

impl<T, F: Fn(u32) -> (T, Interval)> EntropyModel<PRECISION> for Lookup<F> {
    type Symbol = T;
    type Probability = u32;
}

impl<T, F: Fn(u32) -> (T, Interval)> DecoderModel<PRECISION> for Lookup<F> {
    #[inline]
    fn quantile_function(&self, quantile: u32) -> (T, u32, NonZeroU32) {
        let (symbol, interval) = (self.0)(quantile);
        let (start, size) = interval.parts();
        (symbol, start, size)
    }
}

/// Collects symbols; the first is decoded first.
#[derive(Debug, Default)]
pub(crate) struct Encoder {
    intervals: Vec<Interval>,
}

impl Encoder {
    pub fn push(&mut self, interval: Interval) {
        self.intervals.push(interval);
    }

    /// Adds the lowest `count` bits of `value`, the highest of them first.
    pub fn push_bits(&mut self, value: u32, count: u32) {
        for i in (0..count).rev() {
            self.push(bit_interval(value >> i & 1 == 1));
        }
    }

    /// Returns the words of the stream. The last symbol is coded first: the coder is a stack.
    pub fn finish(self) -> Vec<u32> {
        let mut coder = AnsCoder::<u32, u64>::new();
        for interval in self.intervals.iter().rev() {
            coder.encode_symbol((), *interval).expect("every interval is coded, memory never fails");
        }
        coder.into_compressed().expect("memory never fails")
    }
}

/// Decodes the symbols of a stream. Beyond the end of a damaged stream, symbols are arbitrary.
#[derive(Debug)]
pub(crate) struct Decoder {
    coder: AnsCoder<u32, u64>,
}

impl Decoder {
    /// Returns `None` for words that no encoder writes: a zero at the end.
    pub fn new(words: Vec<u32>) -> Option<Self> {
        AnsCoder::from_compressed(words).ok().map(|coder| Self { coder })
    }

    #[inline]
    pub fn next<T>(&mut self, symbol: impl Fn(u32) -> (T, Interval)) -> T {
        let Ok(symbol) = self.coder.decode_symbol(Lookup(symbol));
        symbol
    }

    pub fn next_bit(&mut self) -> bool {
        self.next(|quantile| (quantile >= TOTAL / 2, bit_interval(quantile >= TOTAL / 2)))
    }

    pub fn next_bits(&mut self, count: u32) -> u32 {
        (0..count).fold(0, |value, _| value << 1 | u32::from(self.next_bit()))
    }

    pub fn is_finished(&self) -> bool {
        self.coder.is_empty()
    }
}

fn bit_interval(bit: bool) -> Interval {
    Interval { start: if bit { TOTAL / 2 } else { 0 }, size: TOTAL / 2 }
}

/// Adds ascending token ids below `num_patches`: a flag per patch, with the probability that the tokens and patches left
/// give it, which takes log2 of N over S bits.
pub(crate) fn encode_ids(encoder: &mut Encoder, ids: &[u32], num_patches: usize) {
    let mut left = ids;
    for patch in 0..num_patches {
        let is_token = left.first() == Some(&(patch as u32));
        if let Some(taken) = taken_interval(left.len(), num_patches - patch) {
            encoder.push(if is_token { taken } else { complement(taken) });
        }
        left = if is_token { &left[1..] } else { left };
    }
    debug_assert!(left.is_empty(), "ids are ascending and below num_patches");
}

/// Decodes `num_tokens` ascending ids below `num_patches`; `num_tokens` is at most `num_patches`.
pub(crate) fn decode_ids(decoder: &mut Decoder, num_tokens: usize, num_patches: usize) -> Vec<u32> {
    let mut ids = Vec::new();
    for patch in 0..num_patches {
        let left = num_tokens - ids.len();
        let is_token = match taken_interval(left, num_patches - patch) {
            None => left > 0,
            Some(taken) => decoder.next(|quantile| {
                let is_token = quantile < taken.size;
                (is_token, if is_token { taken } else { complement(taken) })
            }),
        };
        if is_token {
            ids.push(patch as u32);
        }
    }
    ids
}

/// Returns the interval of the flag of a token; `None` if no flag is needed.
fn taken_interval(tokens_left: usize, patches_left: usize) -> Option<Interval> {
    let size = (u64::from(TOTAL) * tokens_left as u64 / patches_left as u64) as u32;
    (tokens_left > 0 && tokens_left < patches_left).then(|| Interval { start: 0, size: size.clamp(1, TOTAL - 1) })
}

fn complement(taken: Interval) -> Interval {
    Interval { start: taken.size, size: TOTAL - taken.size }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ids_take_the_bits_of_their_number_of_subsets() {
        let log2_factorial = |n: usize| (1..=n).map(|i| (i as f64).log2()).sum::<f64>();
        for (num_patches, num_tokens) in [(1, 1), (7, 7), (256, 64), (4096, 1024), (1000, 1)] {
            let ids: Vec<u32> = (0..num_tokens).map(|i| (i * num_patches / num_tokens) as u32).collect();
            let mut encoder = Encoder::default();
            encode_ids(&mut encoder, &ids, num_patches);
            let words = encoder.finish();
            let subsets =
                log2_factorial(num_patches) - log2_factorial(num_tokens) - log2_factorial(num_patches - num_tokens);
            assert!(words.len() as f64 * 32.0 <= subsets * 1.001 + 64.0, "{} words, {subsets} bits", words.len());
            let mut decoder = Decoder::new(words).unwrap();
            assert_eq!(decode_ids(&mut decoder, num_tokens, num_patches), ids);
            assert!(decoder.is_finished());
        }
    }
}
