//! Random streams as functions of (seed, step, slot), never of threads.
//!
//! A run that stops at any step and resumes there samples the same values, because no generator has a state that must
//! be saved. Every use of randomness names its purpose, so that two uses never share a stream.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Slot number of the stream shared by a whole batch; no batch has this many slots.
const WHOLE_BATCH: u32 = u32::MAX;

/// Derives the seed of one part of a run ("stage1", "stage2", "eval"), so that the parts use different streams.
pub fn derive_seed(seed: u64, purpose: &str) -> u64 {
    mix(seed ^ mix(purpose_tag(purpose)))
}

/// Returns the generator of one item of a batch: slot `slot` at step `step`, in its `attempt`-th attempt.
///
/// Equal numbers with different purposes give unrelated streams.
pub fn item_rng(seed: u64, step: u64, slot: u32, attempt: u32, purpose: &str) -> ChaCha8Rng {
    keyed_rng(seed, purpose, step, (u64::from(attempt) << 32) | u64::from(slot))
}

/// Returns the generator of the values that all items of the batch at `step` share, such as the number of contexts.
pub fn step_rng(seed: u64, step: u64, purpose: &str) -> ChaCha8Rng {
    keyed_rng(seed, purpose, step, u64::from(WHOLE_BATCH))
}

/// Samples uniformly from `0..count`; `count` must be at least 1.
///
/// The value is the high half of a 64 x 64 bit product, because the ranges of `rand` may sample differently in a later
/// release. The bias is below `count / 2^64`.
pub fn uniform_below(rng: &mut impl Rng, count: usize) -> usize {
    debug_assert!(count > 0, "the range is empty");
    ((u128::from(rng.next_u64()) * count as u128) >> 64) as usize
}

/// Samples uniformly from `low..=high`.
pub fn uniform_between(rng: &mut impl Rng, low: usize, high: usize) -> usize {
    low + uniform_below(rng, high - low + 1)
}

/// Samples uniformly from `[0, 1)`, in steps of `2^-53`.
pub fn uniform_01(rng: &mut impl Rng) -> f64 {
    (rng.next_u64() >> 11) as f64 / (1_u64 << 53) as f64
}

/// Samples `count` distinct values of `0..range` uniformly, in increasing order (Floyd's algorithm).
pub fn sample_distinct(rng: &mut impl Rng, range: usize, count: usize) -> Vec<usize> {
    let mut sampled = Vec::with_capacity(count);
    for last in range - count..range {
        let value = uniform_below(rng, last + 1);
        sampled.push(if sampled.contains(&value) { last } else { value });
    }
    sampled.sort_unstable();
    sampled
}

/// Samples `count` of `values` without replacement, in random order.
pub fn sample_from(rng: &mut impl Rng, mut values: Vec<usize>, count: usize) -> Vec<usize> {
    for i in 0..count {
        let j = uniform_between(rng, i, values.len() - 1);
        values.swap(i, j);
    }
    values.truncate(count);
    values
}

/// Returns the generator whose 32-byte cipher key is the four numbers: distinct numbers give distinct streams.
fn keyed_rng(seed: u64, purpose: &str, step: u64, item: u64) -> ChaCha8Rng {
    let mut key = [0; 32];
    key.copy_from_slice([seed, purpose_tag(purpose), step, item].map(u64::to_le_bytes).as_flattened());
    ChaCha8Rng::from_seed(key)
}

/// Returns the FNV-1a hash of a purpose.
fn purpose_tag(purpose: &str) -> u64 {
    purpose.bytes().fold(0xcbf2_9ce4_8422_2325, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3))
}

/// Mixes 64 bits with the finaliser of `SplitMix64`, a bijection.
pub fn mix(value: u64) -> u64 {
    let value = value.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let value = (value ^ (value >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let value = (value ^ (value >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    value ^ (value >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::collections::BTreeSet;

    // The expected values come from an implementation of ChaCha8 and of this file in Python.
    #[test]
    fn the_streams_are_the_same_on_every_platform_and_in_every_release() {
        assert_eq!(item_rng(7, 1500, 3, 0, "views").next_u64(), 11_319_778_517_792_920_923);
        assert_eq!(step_rng(7, 1500, "views").next_u64(), 5_891_222_139_913_767_078);
        assert_eq!(derive_seed(7, "stage1"), 15_274_277_896_134_325_637);
        let mut rng = step_rng(1, 2, "draws");
        assert_eq!([(); 6].map(|()| uniform_below(&mut rng, 1000)), [152, 127, 472, 593, 99, 357]);
    }

    #[test]
    fn streams_differ_in_seed_step_slot_attempt_and_purpose() {
        let items = [(1, 2, 3, 0, "views"), (2, 2, 3, 0, "views"), (1, 3, 3, 0, "views"), (1, 2, 4, 0, "views")];
        let others = [(1, 2, 3, 1, "views"), (1, 2, 3, 0, "count"), (1, 3, 2, 0, "views")];
        let items = items
            .into_iter()
            .chain(others)
            .map(|(seed, step, slot, attempt, purpose)| item_rng(seed, step, slot, attempt, purpose));
        let steps = [(1, "views"), (1, "count"), (derive_seed(1, "stage2"), "count")];
        let steps = steps.into_iter().map(|(seed, purpose)| step_rng(seed, 2, purpose));
        let firsts: BTreeSet<u64> = items.chain(steps).map(|mut rng| rng.next_u64()).collect();
        assert_eq!(firsts.len(), 10);
    }

    proptest! {
        #[test]
        fn distinct_values_are_distinct_sorted_and_in_range(seed: u64, range in 0_usize..50, share in 0.0_f64..=1.0) {
            let count = (range as f64 * share) as usize;
            let sampled = sample_distinct(&mut step_rng(seed, 0, "test"), range, count);
            prop_assert_eq!(sampled.len(), count);
            prop_assert!(sampled.windows(2).all(|pair| pair[0] < pair[1]));
            prop_assert!(sampled.iter().all(|&value| value < range));
        }
    }
}
