//! The scene of every batch slot: a function of (seed, step, slot) alone.

use clift_core::{check_config, derive_seed, mix};

use crate::error::DataError;

/// Rounds of the Feistel network behind [`SceneOrder`]. Four suffice in theory; more cost nothing.
const FEISTEL_ROUNDS: u64 = 8;

/// The scene of each batch slot: a new seeded permutation of all scenes per epoch, read in order.
///
/// Position `step * batch_size + slot` of the endless sequence lies in epoch `position / num_scenes`. The permutation is
/// computed point by point (a Feistel network with cycle walking): it needs no memory, and a run resumes at any step
/// without replaying earlier ones.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SceneOrder {
    seed: u64,
    num_scenes: u64,
    batch_size: u64,
    half_bits: u32,
}

impl SceneOrder {
    pub fn new(seed: u64, num_scenes: usize, batch_size: usize) -> Result<Self, DataError> {
        for (key, value) in [("num_scenes", num_scenes), ("batch_size", batch_size)] {
            check_config(value > 0, key, 0, || "use at least 1".into())?;
        }
        let num_scenes = num_scenes as u64;
        let bits = (u64::BITS - (num_scenes - 1).leading_zeros()).max(2);
        let seed = derive_seed(seed, "scene order");
        Ok(Self { seed, num_scenes, batch_size: batch_size as u64, half_bits: bits.div_ceil(2) })
    }

    /// Returns the scene, in `0..num_scenes`, of batch slot `slot` at `step`.
    pub fn scene(&self, step: u64, slot: usize) -> usize {
        let position = u128::from(step) * u128::from(self.batch_size) + slot as u128;
        let num_scenes = u128::from(self.num_scenes);
        self.permuted((position / num_scenes) as u64, (position % num_scenes) as u64) as usize
    }

    fn permuted(&self, epoch: u64, position: u64) -> u64 {
        let key = mix(self.seed ^ mix(epoch));
        let mut value = position;
        // The network permutes 0..4^half_bits, at most 8 times too many values. Repeat until the value is a scene.
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

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::collections::BTreeSet;

    #[test]
    fn scene_order_is_reproducible() {
        let order = SceneOrder::new(7, 10, 5).unwrap();
        let epochs: Vec<usize> = (0..4)
            .flat_map(|step| (0..5).map(move |slot| (step, slot)))
            .map(|(step, slot)| order.scene(step, slot))
            .collect();
        assert_eq!(epochs, [0, 4, 5, 6, 2, 3, 9, 1, 7, 8, 2, 1, 4, 9, 7, 8, 3, 6, 0, 5]);
        assert_eq!(SceneOrder::new(7, 67_477, 8).unwrap().scene(30_000, 5), 34_403);
    }

    proptest! {
        #[test]
        fn an_epoch_reads_every_scene_once(seed: u64, num_scenes in 1_usize..400, batch in 1_usize..9, epoch in 0_u64..1_000) {
            let order = SceneOrder::new(seed, num_scenes, batch).unwrap();
            let first = epoch * num_scenes as u64;
            let scenes: BTreeSet<usize> = (first..first + num_scenes as u64)
                .map(|position| order.scene(position / batch as u64, (position % batch as u64) as usize))
                .collect();
            prop_assert_eq!(scenes, (0..num_scenes).collect());
        }
    }
}
