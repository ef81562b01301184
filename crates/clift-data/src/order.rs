//! What is drawn when: randomness and scene order as functions of (seed, step, slot), never of threads.
//!
//! A run that stops at any step and starts again there sees the same scenes and the same draws, because
//! nothing here has a state that would have to be saved. Every use of randomness names its purpose, so that
//! two uses never share a stream.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::error::DataError;

/// Rounds of the Feistel network behind [`SceneOrder`]; four suffice in theory, small rooms for error cost nothing.
const FEISTEL_ROUNDS: u64 = 8;
/// Stands in the slot's place for what a whole batch shares; no batch has this many slots.
const WHOLE_BATCH: u32 = u32::MAX;

/// Derives the seed of one part of a run ("stage1", "stage2", "eval"), so that parts do not repeat each other.
pub fn derive_seed(seed: u64, purpose: &str) -> u64 {
    mix(seed ^ mix(purpose_tag(purpose)))
}

/// Makes the generator for one item of a batch: batch slot `slot` at `step`, on its `attempt`-th scene.
///
/// `purpose` keeps uses apart: equal numbers with different purposes give unrelated streams.
pub fn item_rng(seed: u64, step: u64, slot: u32, attempt: u32, purpose: &str) -> ChaCha8Rng {
    keyed_rng(seed, purpose, step, (u64::from(attempt) << 32) | u64::from(slot))
}

/// Makes the generator for what all items of the batch at `step` share, such as the number of contexts.
pub fn step_rng(seed: u64, step: u64, purpose: &str) -> ChaCha8Rng {
    keyed_rng(seed, purpose, step, u64::from(WHOLE_BATCH))
}

/// Draws uniformly from `0..count`; `count` must be at least 1.
///
/// Written out (high half of a 64 x 64 bit product) instead of taken from `rand`, whose ranges may draw
/// differently in a later release. The bias is below `count / 2^64`.
pub fn below(rng: &mut impl Rng, count: usize) -> usize {
    debug_assert!(count > 0, "nothing to draw from");
    ((u128::from(rng.next_u64()) * count as u128) >> 64) as usize
}

/// Draws uniformly from `low..=high`.
pub(crate) fn between(rng: &mut impl Rng, low: usize, high: usize) -> usize {
    low + below(rng, high - low + 1)
}

/// Draws uniformly from `[0, 1)`, in steps of `2^-53`.
pub(crate) fn unit(rng: &mut impl Rng) -> f64 {
    (rng.next_u64() >> 11) as f64 / (1_u64 << 53) as f64
}

/// Draws `count` distinct values of `0..range` uniformly, in increasing order (Floyd's algorithm).
pub(crate) fn distinct(rng: &mut impl Rng, range: usize, count: usize) -> Vec<usize> {
    let mut drawn = Vec::with_capacity(count);
    for last in range - count..range {
        let value = below(rng, last + 1);
        drawn.push(if drawn.contains(&value) { last } else { value });
    }
    drawn.sort_unstable();
    drawn
}

/// Draws `count` of `values` without replacement, in random order.
pub(crate) fn draw_from(rng: &mut impl Rng, mut values: Vec<usize>, count: usize) -> Vec<usize> {
    for i in 0..count {
        let j = between(rng, i, values.len() - 1);
        values.swap(i, j);
    }
    values.truncate(count);
    values
}

/// Which scene each slot of each batch takes: a new seeded permutation of all scenes per epoch, read in order.
///
/// Position `step * batch_size + slot` of the endless sequence lies in epoch `position / num_scenes`. The
/// permutation is computed point by point (a Feistel network with cycle walking), so a million scenes cost no
/// memory and any step is reached at once.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SceneOrder {
    seed: u64,
    num_scenes: u64,
    batch_size: u64,
    half_bits: u32,
}

impl SceneOrder {
    /// Makes the order of `num_scenes` scenes in batches of `batch_size`.
    ///
    /// # Errors
    /// [`DataError::BadConfig`] when there are no scenes or a batch has no slots.
    pub fn new(seed: u64, num_scenes: usize, batch_size: usize) -> Result<Self, DataError> {
        for (key, value) in [("num_scenes", num_scenes), ("batch_size", batch_size)] {
            if value == 0 {
                return Err(DataError::bad_config(key, "is 0; at least 1 is needed"));
            }
        }
        let num_scenes = num_scenes as u64;
        let bits = (u64::BITS - (num_scenes - 1).leading_zeros()).max(2);
        let seed = derive_seed(seed, "scene order");
        Ok(Self { seed, num_scenes, batch_size: batch_size as u64, half_bits: bits.div_ceil(2) })
    }

    /// Scene, in `0..num_scenes`, of batch slot `slot` at `step`.
    pub fn scene(&self, step: u64, slot: usize) -> usize {
        let position = self.position(step, slot);
        self.permuted((position / u128::from(self.num_scenes)) as u64, (position % u128::from(self.num_scenes)) as u64)
            as usize
    }

    /// Slots per batch.
    pub fn batch_size(&self) -> usize {
        self.batch_size as usize
    }

    fn position(&self, step: u64, slot: usize) -> u128 {
        u128::from(step) * u128::from(self.batch_size) + slot as u128
    }

    fn permuted(&self, epoch: u64, place: u64) -> u64 {
        let key = mix(self.seed ^ mix(epoch));
        let mut value = place;
        // The network permutes 0..4^half_bits, at most 8 times too many values: walk on until one fits.
        loop {
            value = self.feistel(key, value);
            if value < self.num_scenes {
                return value;
            }
        }
    }

    fn feistel(&self, key: u64, value: u64) -> u64 {
        let mask = (1_u64 << self.half_bits) - 1;
        let (mut left, mut right) = (value >> self.half_bits, value & mask);
        for round in 0..FEISTEL_ROUNDS {
            let next = left ^ (mix(mix(key.wrapping_add(round)) ^ right) & mask);
            (left, right) = (right, next);
        }
        (left << self.half_bits) | right
    }
}

/// The 32-byte key of the cipher is the four numbers themselves: distinct numbers cannot meet in one stream.
fn keyed_rng(seed: u64, purpose: &str, step: u64, item: u64) -> ChaCha8Rng {
    let mut key = [0; 32];
    for (bytes, value) in key.chunks_exact_mut(8).zip([seed, purpose_tag(purpose), step, item]) {
        bytes.copy_from_slice(&value.to_le_bytes());
    }
    ChaCha8Rng::from_seed(key)
}

/// FNV-1a hash of a purpose's name.
fn purpose_tag(purpose: &str) -> u64 {
    purpose.bytes().fold(0xcbf2_9ce4_8422_2325, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3))
}

/// The finaliser of `SplitMix64`: a bijection of 64 bits that spreads every input bit over the output.
fn mix(value: u64) -> u64 {
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
        assert_eq!([(); 6].map(|()| below(&mut rng, 1000)), [152, 127, 472, 593, 99, 357]);
    }

    #[test]
    fn the_scene_order_is_the_same_on_every_platform_and_in_every_release() {
        let order = SceneOrder::new(7, 10, 5).unwrap();
        let epochs: Vec<usize> = (0..4)
            .flat_map(|step| (0..5).map(move |slot| (step, slot)))
            .map(|(step, slot)| order.scene(step, slot))
            .collect();
        assert_eq!(epochs, [0, 4, 5, 6, 2, 3, 9, 1, 7, 8, 2, 1, 4, 9, 7, 8, 3, 6, 0, 5]);
        assert_eq!(SceneOrder::new(7, 67_477, 8).unwrap().scene(30_000, 5), 34_403);
    }

    #[test]
    fn streams_differ_in_seed_step_slot_attempt_and_purpose() {
        let firsts: BTreeSet<u64> = [
            item_rng(1, 2, 3, 0, "views"),
            item_rng(2, 2, 3, 0, "views"),
            item_rng(1, 3, 3, 0, "views"),
            item_rng(1, 2, 4, 0, "views"),
            item_rng(1, 2, 3, 1, "views"),
            item_rng(1, 2, 3, 0, "count"),
            item_rng(1, 3, 2, 0, "views"),
            step_rng(1, 2, "views"),
            step_rng(1, 2, "count"),
            step_rng(derive_seed(1, "stage2"), 2, "count"),
        ]
        .map(|mut rng| rng.next_u64())
        .into();
        assert_eq!(firsts.len(), 10);
    }

    #[test]
    fn every_scene_comes_to_every_place_equally_often_over_many_epochs() {
        // 5,000 epochs of 5 scenes: each of the 25 counts is binomial with mean 1,000 and deviation 28.
        let order = SceneOrder::new(3, 5, 5).unwrap();
        let mut counts = [[0_i32; 5]; 5];
        for epoch in 0..5_000 {
            for (place, row) in counts.iter_mut().enumerate() {
                row[order.scene(epoch, place)] += 1;
            }
        }
        assert!(counts.iter().flatten().all(|count| (count - 1_000).abs() < 140), "{counts:?}");
    }

    #[test]
    fn epochs_are_ordered_differently() {
        let order = SceneOrder::new(3, 1_000, 1_000).unwrap();
        let same = (0..1_000).filter(|&slot| order.scene(0, slot) == order.scene(1, slot)).count();
        assert!(same < 10, "{same} of 1000 scenes kept their place");
    }

    #[test]
    fn an_order_without_scenes_or_slots_is_refused() {
        assert!(SceneOrder::new(0, 0, 1).unwrap_err().to_string().contains("num_scenes"));
        assert!(SceneOrder::new(0, 1, 0).unwrap_err().to_string().contains("batch_size"));
    }

    proptest! {
        #[test]
        fn an_epoch_takes_every_scene_once_whatever_the_batch_size(seed: u64, num_scenes in 1_usize..400, batch in 1_usize..9, epoch in 0_u64..1_000) {
            let order = SceneOrder::new(seed, num_scenes, batch).unwrap();
            let first = epoch * num_scenes as u64;
            let scenes: BTreeSet<usize> = (first..first + num_scenes as u64)
                .map(|position| order.scene(position / batch as u64, (position % batch as u64) as usize))
                .collect();
            prop_assert_eq!(scenes, (0..num_scenes).collect());
        }

        #[test]
        fn distinct_values_are_distinct_sorted_and_in_range(seed: u64, range in 0_usize..50, share in 0.0_f64..=1.0) {
            let count = (range as f64 * share) as usize;
            let drawn = distinct(&mut step_rng(seed, 0, "test"), range, count);
            prop_assert_eq!(drawn.len(), count);
            prop_assert!(drawn.windows(2).all(|pair| pair[0] < pair[1]));
            prop_assert!(drawn.iter().all(|&value| value < range));
        }

        #[test]
        fn draws_stay_below_their_count(seed: u64, count in 1_usize..=usize::MAX) {
            prop_assert!(below(&mut step_rng(seed, 0, "test"), count) < count);
        }
    }
}
