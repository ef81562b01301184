//! The parts of a batch, and those that a rank works off.

use std::ops::Range;

use crate::distributed::ranks::Ranks;

/// The division of a batch into parts of nearly equal size, each with a backward of its own.
///
/// Rank r of R works off the parts r, r + R, r + 2 R, .. Each round has R parts, whose gradients are added in their order,
/// so that the sum over all rounds has the order of one process.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BatchParts {
    batch_size: usize,
    num_parts: usize,
    rank: usize,
    num_ranks: usize,
}

impl BatchParts {
    /// Divides a batch into `accumulate` parts, and into one part for every rank if there are more ranks.
    pub fn new(batch_size: usize, accumulate: usize, ranks: &Ranks) -> Self {
        let (rank, num_ranks) = (ranks.rank(), ranks.num_ranks());
        Self { batch_size, num_parts: accumulate.max(num_ranks.min(batch_size)), rank, num_ranks }
    }

    /// Returns the scenes of the whole batch.
    pub fn batch_size(&self) -> usize {
        self.batch_size
    }

    /// Returns the number of parts of all ranks.
    pub fn num_parts(&self) -> usize {
        self.num_parts
    }

    /// Returns the number of rounds: the most parts of a rank.
    pub fn num_rounds(&self) -> usize {
        self.num_parts.div_ceil(self.num_ranks)
    }

    /// Returns the number of ranks that have a part in a round; these are the first ones.
    pub fn num_working(&self, round: usize) -> usize {
        self.num_ranks.min(self.num_parts - round * self.num_ranks)
    }

    /// Returns the slots of this rank's part in a round; none if the rank has no part.
    pub fn slots_of_round(&self, round: usize) -> Range<usize> {
        let part = round * self.num_ranks + self.rank;
        let bound = |part: usize| part.min(self.num_parts) * self.batch_size / self.num_parts;
        bound(part)..bound(part + 1)
    }

    /// Returns the slots of this rank, in ascending order.
    pub fn slots(&self) -> impl Iterator<Item = usize> {
        let parts = *self;
        (0..parts.num_rounds()).flat_map(move |round| parts.slots_of_round(round))
    }
}
