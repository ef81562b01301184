//! Messages between ranks, and failures that all ranks learn of.

use std::cell::Cell;
use std::fmt::Display;
use std::ops::Range;

use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::distributed::communicator::{Communicator, SingleProcess};
use crate::error::TrainError;

/// First byte of a message: a value follows, or the text of an error.
const VALUE: u8 = 0;
const FAILURE: u8 = 1;
/// Values that are exchanged at once, 16 MB: the fastest of 4, 16, 64 MB and all on two busy cores.
const BLOCK: usize = 1 << 22;

/// The ranks of a run, seen from one of them.
///
/// Every exchange of messages may bring the failure of another rank instead of its value: a rank that fails anywhere sends
/// one message in [`Ranks::finish`], and the others, which wait for its next message, end with [`TrainError::OtherRank`].
/// Raw values are exchanged only right after messages, with nothing in between that can fail.
pub struct Ranks {
    communicator: Box<dyn Communicator>,
    /// Whether every rank knows of a failure.
    has_failed: Cell<bool>,
}

impl Ranks {
    /// Returns the only rank of a run in one process.
    pub fn single() -> Self {
        Self::new(Box::new(SingleProcess))
    }

    /// Returns the ranks of a communicator.
    pub fn new(communicator: Box<dyn Communicator>) -> Self {
        Self { communicator, has_failed: Cell::new(false) }
    }

    /// Returns the number of this rank, from 0.
    pub fn rank(&self) -> usize {
        self.communicator.rank()
    }

    /// Returns the number of ranks.
    pub fn num_ranks(&self) -> usize {
        self.communicator.num_ranks()
    }

    /// Whether this is rank 0, which alone writes files and prints.
    pub fn is_root(&self) -> bool {
        self.rank() == 0
    }

    /// Returns the values of all ranks, by rank.
    ///
    /// # Errors
    /// [`TrainError::OtherRank`] if another rank has failed.
    pub fn gather<T: Serialize + DeserializeOwned>(&self, own: T) -> Result<Vec<T>, TrainError> {
        if self.num_ranks() == 1 {
            return Ok(vec![own]);
        }
        let mut message = vec![VALUE];
        ciborium::into_writer(&own, &mut message).expect("memory takes every value");
        let decode = |(rank, bytes): (usize, Vec<u8>)| {
            ciborium::from_reader(bytes.as_slice()).map_err(|_| TrainError::OtherRank {
                rank,
                reason: "it sent an unknown message; start the same program on every rank".into(),
            })
        };
        self.exchange(&message)?.into_iter().enumerate().map(decode).collect()
    }

    /// Returns the value that rank 0 makes.
    ///
    /// # Errors
    /// As [`Ranks::gather`]; on rank 0 those of `make`.
    pub fn from_root<T: Serialize + DeserializeOwned>(
        &self,
        make: impl FnOnce() -> Result<T, TrainError>,
    ) -> Result<T, TrainError> {
        // A list: CBOR writes `Some(None)` as `None`.
        let own = if self.is_root() { vec![make()?] } else { Vec::new() };
        Ok(self.gather(own)?.swap_remove(0).pop().expect("rank 0 made a value"))
    }

    /// Returns whether the flag of any rank is set.
    pub fn any(&self, flag: bool) -> Result<bool, TrainError> {
        Ok(self.gather(flag)?.contains(&true))
    }

    /// Checks that a value is the same on every rank.
    ///
    /// # Errors
    /// [`TrainError::RanksDiffer`], and those of [`Ranks::gather`].
    pub fn require_same(&self, what: &'static str, value: &str) -> Result<(), TrainError> {
        let all = self.gather(value.to_owned())?;
        match all.iter().position(|other| *other != all[0]) {
            None => Ok(()),
            Some(rank) => Err(TrainError::RanksDiffer { what, rank }),
        }
    }

    /// Ends a run: tells the other ranks of a failure, or learns of theirs, and waits until every rank is here. A launcher
    /// ends all ranks with the first, and rank 0 may still be saving.
    pub fn finish<T, E: Display + From<TrainError>>(&self, result: Result<T, E>) -> Result<T, E> {
        if self.num_ranks() == 1 {
            return result;
        }
        let result = if self.has_failed.get() {
            result
        } else {
            let message = match &result {
                Ok(_) => vec![VALUE],
                Err(error) => [vec![FAILURE], format!("{error:#}").into_bytes()].concat(),
            };
            let others = self.exchange(&message);
            result.and_then(|value| others.map(|_| value).map_err(E::from))
        };
        self.communicator.all_gather(&[]);
        result
    }

    /// Sends a message to all ranks, and returns theirs without the first byte.
    fn exchange(&self, message: &[u8]) -> Result<Vec<Vec<u8>>, TrainError> {
        let mut all = self.communicator.all_gather(message);
        if let Some(rank) = all.iter().position(|message| message.first() != Some(&VALUE)) {
            self.has_failed.set(true);
            let reason = String::from_utf8_lossy(all[rank].get(1..).unwrap_or_default()).into_owned();
            return Err(TrainError::OtherRank { rank, reason });
        }
        for message in &mut all {
            message.remove(0);
        }
        Ok(all)
    }

    /// Returns the range of a block of `len` values that each rank adds up.
    fn ranges(&self, len: usize) -> Vec<Range<usize>> {
        let num_ranks = self.num_ranks();
        (0..num_ranks).map(|rank| rank * len / num_ranks..(rank + 1) * len / num_ranks).collect()
    }

    /// Adds the `len` values of the first `num_senders` ranks, in their order, to `sum`, which holds this rank's range of
    /// every block, or nothing before the first call.
    pub(crate) fn add_ranges(&self, values: &[f32], len: usize, num_senders: usize, sum: &mut Vec<f32>) {
        let (is_first, mut start) = (sum.is_empty(), 0);
        for block in blocks(len) {
            let ranges = self.ranges(block.len());
            let own = ranges[self.rank()].len();
            // A rank that does not send has no values.
            let sent = values.get(block).unwrap_or_default();
            let received = self.communicator.all_to_all(sent, &ranges, num_senders);
            let mut of_senders = received.chunks_exact(own.max(1));
            if is_first {
                sum.extend_from_slice(of_senders.next().unwrap_or_default());
            }
            let target = &mut sum[start..start + own];
            for values in of_senders {
                target.iter_mut().zip(values).for_each(|(sum, value)| *sum += value);
            }
            start += own;
        }
    }

    /// Returns all `len` values, of which every rank has its range of every block.
    pub(crate) fn join_ranges(&self, mut own: &[f32], len: usize) -> Vec<f32> {
        let mut values = vec![0.0; len];
        for block in blocks(len) {
            let (ranges, target) = (self.ranges(block.len()), &mut values[block]);
            let of_rank = ranges[self.rank()].clone();
            let (first, rest) = own.split_at(of_rank.len());
            target[of_rank].copy_from_slice(first);
            self.communicator.all_gather_values(target, &ranges);
            own = rest;
        }
        values
    }
}

/// Returns the bytes that each of `num_ranks` ranks sends to sum `num_values` f32 values: as many as in a ring.
pub(crate) fn sent_bytes(num_values: u64, num_ranks: usize) -> u64 {
    let num_ranks = num_ranks as u64;
    2 * (num_ranks - 1) * 4 * num_values / num_ranks
}

/// Returns the blocks of `len` values.
fn blocks(len: usize) -> impl Iterator<Item = Range<usize>> {
    (0..len).step_by(BLOCK).map(move |start| start..len.min(start + BLOCK))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::distributed::testing::on_threads;

    /// Returns the sum of the values of all ranks.
    fn sum(ranks: &Ranks, values: &[f32]) -> Vec<f32> {
        let mut sum = Vec::new();
        ranks.add_ranges(values, values.len(), ranks.num_ranks(), &mut sum);
        ranks.join_ranges(&sum, values.len())
    }

    #[test]
    fn sums_are_added_in_the_order_of_ranks() {
        // Rounding depends on the order: 1 is lost beside 1e8, unless -1e8 comes before it.
        let of_rank = [[1e8_f32, 1.0, -0.0], [-1e8, 1e8, -0.0], [1.0, -1e8, -0.0]];
        for num_ranks in 1..=3 {
            let sums = on_threads(num_ranks, |ranks| sum(&ranks, &of_rank[ranks.rank()]));
            let expected: Vec<u32> = (0..3)
                .map(|i| of_rank[1..num_ranks].iter().fold(of_rank[0][i], |sum, values| sum + values[i]).to_bits())
                .collect();
            for sum in sums {
                assert_eq!(sum.into_iter().map(f32::to_bits).collect::<Vec<_>>(), expected, "{num_ranks} ranks");
            }
        }
    }

    #[test]
    fn fewer_values_than_ranks_are_summed() {
        assert_eq!(on_threads(3, |ranks| sum(&ranks, &[1.5])), vec![[4.5]; 3]);
        assert_eq!(on_threads(3, |ranks| sum(&ranks, &[])), vec![[0.0; 0]; 3]);
    }

    #[test]
    fn long_vectors_are_summed_in_blocks() {
        let len = 2 * BLOCK + 1001;
        let value = |rank: usize, i: usize| ((rank + 1) * (i % 4093)) as f32 * 0.3;
        let sums = on_threads(3, |ranks| {
            let own: Vec<f32> = (0..len).map(|i| value(ranks.rank(), i)).collect();
            // Two rounds, of which the second has a part on the first two ranks only.
            let mut sum = Vec::new();
            ranks.add_ranges(&own, len, 3, &mut sum);
            let second = if ranks.rank() < 2 { own } else { Vec::new() };
            ranks.add_ranges(&second, len, 2, &mut sum);
            ranks.join_ranges(&sum, len)
        });
        for sum in sums {
            let expected = |i: usize| (1..5).fold(value(0, i), |sum, part| sum + value(part % 3, i));
            assert!(sum.iter().enumerate().all(|(i, sum)| sum.to_bits() == expected(i).to_bits()));
        }
    }

    #[test]
    fn values_that_are_not_finite_arrive() {
        let all = on_threads(2, |ranks| ranks.gather((ranks.rank(), f64::NAN, f64::INFINITY)).unwrap());
        for (rank, (number, nan, infinity)) in all.concat().into_iter().enumerate() {
            assert!(number == rank % 2 && nan.is_nan() && infinity == f64::INFINITY);
        }
    }

    #[test]
    fn failure_of_a_rank_ends_the_others_wherever_they_wait() {
        for failing in 0..3 {
            let ended = on_threads(3, |ranks| {
                let work = || {
                    if ranks.rank() == failing {
                        return Err(TrainError::NoScenes { reason: "torn".into() });
                    }
                    // The others are at different places of their work.
                    for _ in 0..5 {
                        ranks.any(false)?;
                    }
                    Ok(())
                };
                ranks.finish(work()).unwrap_err().to_string()
            });
            for (rank, text) in ended.into_iter().enumerate() {
                let own = "no usable scene: torn".to_owned();
                let expected = if rank == failing { own } else { format!("rank {failing} failed: {own}") };
                assert_eq!(text, expected);
            }
        }
    }

    #[test]
    fn failures_after_the_last_exchange_are_told_in_finish() {
        let ended = on_threads(2, |ranks| {
            let own = if ranks.is_root() { Ok(1) } else { Err(TrainError::NoScenes { reason: "torn".into() }) };
            ranks.finish(own).is_err()
        });
        assert_eq!(ended, [true, true]);
        assert_eq!(on_threads(2, |ranks| ranks.finish(Ok::<_, TrainError>(7)).unwrap()), [7, 7]);
    }

    #[test]
    fn rank_0_decides_and_differences_are_found() {
        let all = on_threads(3, |ranks| ranks.from_root(|| Ok(ranks.rank() + 5)).unwrap());
        assert_eq!(all, [5, 5, 5]);
        for value in [None, Some(3)] {
            let none =
                on_threads(2, |ranks| ranks.from_root(|| Ok(ranks.is_root().then_some(value).flatten())).unwrap());
            assert_eq!(none, [value, value]);
        }
        on_threads(2, |ranks| ranks.from_root(|| Ok(())).unwrap());
        assert_eq!(on_threads(3, |ranks| ranks.any(ranks.rank() == 2).unwrap()), [true; 3]);
        let found = on_threads(3, |ranks| {
            let value = if ranks.rank() == 1 { "b" } else { "a" };
            ranks.require_same("the weights", value).unwrap_err().to_string()
        });
        assert!(found.iter().all(|text| text.starts_with("the weights of rank 1 differ from rank 0's")), "{found:?}");
    }
}
