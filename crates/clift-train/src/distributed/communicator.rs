//! Exchange of data between the ranks of a run.

use std::ops::Range;

/// The ranks of a run. Every rank calls the same methods in the same order; a rank that is lost ends the others.
pub trait Communicator {
    /// Returns the number of this rank, from 0.
    fn rank(&self) -> usize;

    /// Returns the number of ranks.
    fn num_ranks(&self) -> usize;

    /// Sends a message to every rank, and returns the messages of all ranks by rank.
    fn all_gather(&self, message: &[u8]) -> Vec<Vec<u8>>;

    /// Sends every rank its range of `values`, and returns the ranges that this rank got, joined in the order of their
    /// senders. Only the first `num_senders` ranks send.
    fn all_to_all(&self, values: &[f32], ranges: &[Range<usize>], num_senders: usize) -> Vec<f32>;

    /// Fills `values` with the ranges of all ranks, each of which has set its own.
    fn all_gather_values(&self, values: &mut [f32], ranges: &[Range<usize>]);
}

/// A run in one process.
#[derive(Clone, Copy, Debug)]
pub(crate) struct SingleProcess;

impl Communicator for SingleProcess {
    fn rank(&self) -> usize {
        0
    }

    fn num_ranks(&self) -> usize {
        1
    }

    fn all_gather(&self, message: &[u8]) -> Vec<Vec<u8>> {
        vec![message.to_vec()]
    }

    fn all_to_all(&self, values: &[f32], ranges: &[Range<usize>], num_senders: usize) -> Vec<f32> {
        if num_senders == 0 { Vec::new() } else { values[ranges[0].clone()].to_vec() }
    }

    fn all_gather_values(&self, _values: &mut [f32], _ranges: &[Range<usize>]) {}
}
