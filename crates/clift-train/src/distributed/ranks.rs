//! Messages between ranks, and failures that all ranks learn of.

use std::cell::Cell;
use std::fmt::Display;
use std::ops::Range;

use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::error::TrainError;

/// First byte of a message: a value follows, or the text of an error.
const VALUE: u8 = 0;
const FAILURE: u8 = 1;

/// Exchange of data between ranks. Every rank calls the same methods in the same order; a rank that is lost ends the others.
pub(crate) trait Communicator {
    fn rank(&self) -> usize;

    fn num_ranks(&self) -> usize;

    /// Sends a message to every rank, and returns the messages of all ranks by rank.
    fn all_gather(&self, message: &[u8]) -> Vec<Vec<u8>>;

    /// Sends every rank its range of `values`, and returns the ranges that this rank got, joined in the order of their
    /// senders. Only the first `num_senders` ranks send.
    fn all_to_all(&self, values: &[f32], ranges: &[Range<usize>], num_senders: usize) -> Vec<f32>;

    /// Fills `values` with the ranges of all ranks, each of which has set its own.
    fn all_gather_values(&self, values: &mut [f32], ranges: &[Range<usize>]);
}

/// The ranks of a run, seen from one of them.
///
/// Every exchange of messages may bring the failure of another rank instead of its value: a rank that fails anywhere sends
/// one message in [`Ranks::finish`], and the others, which wait for its next message, end with [`TrainError::OtherRank`].
/// Raw values are exchanged only right after messages, with nothing in between that can fail.
pub struct Ranks {
    /// `None` for a run in one process.
    communicator: Option<Box<dyn Communicator>>,
    /// Whether every rank knows of a failure.
    has_failed: Cell<bool>,
}

impl Ranks {
    /// Returns the only rank of a run in one process.
    pub fn single() -> Self {
        Self { communicator: None, has_failed: Cell::new(false) }
    }

    #[cfg(any(test, feature = "mpi"))]
    pub(crate) fn new(communicator: impl Communicator + 'static) -> Self {
        Self { communicator: Some(Box::new(communicator)), has_failed: Cell::new(false) }
    }

    /// Returns the number of this rank, from 0.
    pub fn rank(&self) -> usize {
        self.communicator.as_ref().map_or(0, |communicator| communicator.rank())
    }

    /// Returns the number of ranks.
    pub fn num_ranks(&self) -> usize {
        self.communicator.as_ref().map_or(1, |communicator| communicator.num_ranks())
    }

    fn communicator(&self) -> &dyn Communicator {
        self.communicator.as_deref().expect("several ranks")
    }

    /// Whether this is rank 0, which alone writes files and prints.
    pub fn is_root(&self) -> bool {
        self.rank() == 0
    }

    /// Returns the values of all ranks, by rank.
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
        self.communicator().all_gather(&[]);
        result
    }

    /// Sends a message to all ranks, and returns theirs without the first byte.
    fn exchange(&self, message: &[u8]) -> Result<Vec<Vec<u8>>, TrainError> {
        let mut all = self.communicator().all_gather(message);
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

    /// Returns the range of `len` values that each rank adds up.
    fn ranges(&self, len: usize) -> Vec<Range<usize>> {
        let num_ranks = self.num_ranks();
        (0..num_ranks).map(|rank| rank * len / num_ranks..(rank + 1) * len / num_ranks).collect()
    }

    /// Adds the `len` values of the first `num_senders` ranks, in their order, to `sum`, which holds this rank's range, or
    /// nothing before the first call. A rank that does not send has no values.
    pub(crate) fn add_ranges(&self, values: &[f32], len: usize, num_senders: usize, sum: &mut Vec<f32>) {
        let ranges = self.ranges(len);
        let received = self.communicator().all_to_all(values, &ranges, num_senders);
        for values in received.chunks_exact(ranges[self.rank()].len().max(1)) {
            if sum.is_empty() {
                sum.extend_from_slice(values);
            } else {
                sum.iter_mut().zip(values).for_each(|(sum, value)| *sum += value);
            }
        }
    }

    /// Returns all `len` values, of which every rank has its range.
    pub(crate) fn join_ranges(&self, own: &[f32], len: usize) -> Vec<f32> {
        let (ranges, mut values) = (self.ranges(len), vec![0.0; len]);
        values[ranges[self.rank()].clone()].copy_from_slice(own);
        self.communicator().all_gather_values(&mut values, &ranges);
        values
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::distributed::testing::on_threads;

    #[test]
    fn failure_of_a_rank_ends_the_others_wherever_they_wait() {
        for failing in 0..3 {
            let ended = on_threads(3, |ranks| {
                let work = || {
                    if ranks.rank() == failing {
                        return Err(TrainError::NoScenes { reason: "torn".into() });
                    }
                    // The others wait in the middle of their work, or at its end.
                    if ranks.rank() == 0 { Ok(()) } else { ranks.any(false).map(drop) }
                };
                ranks.finish(work()).unwrap_err().to_string()
            });
            for (rank, text) in ended.into_iter().enumerate() {
                let expected = "no usable scene: torn".to_owned();
                assert_eq!(text, if rank == failing { expected } else { format!("rank {failing} failed: {expected}") });
            }
        }
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
        assert_eq!(on_threads(3, |ranks| ranks.any(ranks.rank() == 2).unwrap()), [true; 3]);
        let found = on_threads(3, |ranks| {
            let value = if ranks.rank() == 1 { "b" } else { "a" };
            ranks.require_same("the weights", value).unwrap_err().to_string()
        });
        assert!(found.iter().all(|text| text.starts_with("the weights of rank 1 differ from rank 0's")), "{found:?}");
    }
}
