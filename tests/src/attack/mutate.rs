//! Damage: bits, bytes, cuts, splices, lengths, numbers and words, as a function of (reader, seed, number).

use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Boundary values of lengths and counts.
const NUMBERS: &str = "0 1 2 3 7 8 127 128 255 256 32767 32768 65535 65536 2147483647 2147483648 4294967295 4294967296 \
    9223372036854775807 18446744073709551615";

/// Replacements of numbers in texts.
const TEXTS: &str = "0 -1 1 2 65536 4294967296 9223372036854775807 9223372036854775808 18446744073709551615 \
    4611686018427387904 1e308 1e999 -0.0 null";

/// Largest size that insertions produce.
const MOST_BYTES: usize = 1 << 20;

pub struct Mutator<'a> {
    pub seeds: &'a [Vec<u8>],
    pub words: &'a [&'a [u8]],
    /// Corrects checksums, which would hide the damage from later checks.
    pub repair: fn(&mut [u8]),
}

impl Mutator<'_> {
    pub fn input(&self, target: &str, seed: u64, number: u64) -> Vec<u8> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed ^ name_hash(target));
        rng.set_stream(number);
        let mut bytes = self.seeds[below(&mut rng, self.seeds.len())].clone();
        for _ in 0..=below(&mut rng, 6) {
            self.damage(&mut bytes, &mut rng);
        }
        // Half of the inputs pass the checksums.
        if rng.random_bool(0.5) {
            (self.repair)(&mut bytes);
        }
        bytes
    }

    fn damage(&self, bytes: &mut Vec<u8>, rng: &mut ChaCha8Rng) {
        let at = below(rng, bytes.len() + 1).min(bytes.len().saturating_sub(1));
        if bytes.is_empty() {
            bytes.push(rng.random());
            return;
        }
        match below(rng, 12) {
            0 | 1 => bytes[at] ^= 1 << below(rng, 8),
            2 => bytes[at] = rng.random(),
            3 => bytes.truncate(at),
            4 => drop(bytes.drain(at..at + below(rng, (bytes.len() - at).min(64)) + usize::from(bytes.len() > at + 1))),
            5 => {
                let len = 1 + below(rng, (bytes.len() - at).min(4096));
                let part = bytes[at..(at + len).min(bytes.len())].to_vec();
                insert(bytes, at, &part.repeat(1 + below(rng, 4)));
            }
            6 => {
                let other = &self.seeds[below(rng, self.seeds.len())];
                let from = below(rng, other.len());
                let len = 1 + below(rng, other.len() - from);
                bytes.truncate(at);
                bytes.extend_from_slice(&other[from..from + len]);
            }
            7 | 8 => overwrite_number(bytes, at, rng),
            9 => replace_digits(bytes, at, rng),
            _ if self.words.is_empty() => bytes[at] ^= 0x80,
            10 => insert(bytes, at, self.words[below(rng, self.words.len())]),
            _ => overwrite(bytes, at, self.words[below(rng, self.words.len())]),
        }
    }
}

fn below(rng: &mut impl Rng, count: usize) -> usize {
    if count == 0 { 0 } else { rng.random_range(0..count) }
}

fn insert(bytes: &mut Vec<u8>, at: usize, part: &[u8]) {
    if bytes.len() + part.len() <= MOST_BYTES.max(bytes.len()) {
        bytes.splice(at..at, part.iter().copied());
    }
}

/// Overwrites the bytes from a place on, as far as there are any.
fn overwrite(bytes: &mut [u8], at: usize, part: &[u8]) {
    let len = part.len().min(bytes.len() - at);
    bytes[at..at + len].copy_from_slice(&part[..len]);
}

/// A number of 1, 2, 4 or 8 bytes in either order, perhaps near the file's own length.
fn overwrite_number(bytes: &mut [u8], at: usize, rng: &mut ChaCha8Rng) {
    let width = 1_usize << below(rng, 4);
    let number = match below(rng, 4) {
        0 => (bytes.len() as u64).wrapping_add(rng.random_range(0..5)).wrapping_sub(2),
        1 => {
            let mut there = [0; 8];
            overwrite(&mut there[..width], 0, &bytes[at..]);
            u64::from_le_bytes(there).wrapping_add(rng.random_range(0..17)).wrapping_sub(8)
        }
        _ => word_of(NUMBERS, rng).parse().expect("a number"),
    };
    let mut part = number.to_le_bytes()[..width].to_vec();
    if rng.random_bool(0.5) {
        part.reverse();
    }
    overwrite(bytes, at, &part);
}

/// Replaces the next number of a text.
fn replace_digits(bytes: &mut Vec<u8>, at: usize, rng: &mut ChaCha8Rng) {
    let Some(start) = (at..bytes.len()).find(|&i| bytes[i].is_ascii_digit()) else { return };
    let end = (start..bytes.len()).find(|&i| !bytes[i].is_ascii_digit()).unwrap_or(bytes.len());
    bytes.splice(start..end, word_of(TEXTS, rng).bytes());
}

fn word_of(text: &'static str, rng: &mut ChaCha8Rng) -> &'static str {
    let words: Vec<&str> = text.split(' ').collect();
    words[below(rng, words.len())]
}

/// A hash of a name, the same on every platform (FNV-1a).
fn name_hash(name: &str) -> u64 {
    name.bytes().fold(0xcbf2_9ce4_8422_2325, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3))
}
