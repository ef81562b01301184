//! Ranks on MPI.

use std::ops::Range;

use mpi::Threading;
use mpi::datatype::{Partition, PartitionMut};
use mpi::environment::Universe;
use mpi::topology::SimpleCommunicator;
use mpi::traits::{Communicator as _, CommunicatorCollectives};

use crate::distributed::ranks::Communicator;

const PANICKED: i32 = 101;

/// A rank of `MPI_COMM_WORLD`. MPI's own errors end all ranks, its default.
pub(crate) struct MpiRank {
    world: SimpleCommunicator,
    /// `MPI_Finalize` when it is dropped.
    universe: Option<Universe>,
}

impl MpiRank {
    /// Starts MPI; `None` if it was started before.
    pub fn start() -> Option<Self> {
        // Only the main thread of a rank calls MPI.
        let (universe, _) = mpi::initialize_with_threading(Threading::Funneled)?;
        Some(Self { world: universe.world(), universe: Some(universe) })
    }
}

impl Drop for MpiRank {
    fn drop(&mut self) {
        if std::thread::panicking() {
            // The others wait for this rank, and so would `MPI_Finalize`.
            std::mem::forget(self.universe.take());
            self.world.abort(PANICKED);
        }
    }
}

/// Returns the counts of ranges, and the first values of them all.
fn counts(ranges: &[Range<usize>]) -> (Vec<i32>, Vec<i32>) {
    let count = |value: usize| i32::try_from(value).expect("fewer than 2^31 values");
    ranges.iter().map(|range| (count(range.len()), count(range.start))).unzip()
}

/// Returns the end of ranges that follow one another. Open MPI refuses an exchange of nothing.
fn end_of(ranges: &[Range<usize>]) -> usize {
    ranges.last().map_or(0, |last| last.end)
}

/// Returns the ranges of chunks of these lengths, one after the other.
fn ranges_of(lengths: impl IntoIterator<Item = usize>) -> Vec<Range<usize>> {
    let mut end = 0;
    let next = |len: usize| {
        end += len;
        end - len..end
    };
    lengths.into_iter().map(next).collect()
}

impl Communicator for MpiRank {
    fn rank(&self) -> usize {
        self.world.rank() as usize
    }

    fn num_ranks(&self) -> usize {
        self.world.size() as usize
    }

    fn all_gather(&self, message: &[u8]) -> Vec<Vec<u8>> {
        let mut lengths = vec![0_u64; self.num_ranks()];
        self.world.all_gather_into(&(message.len() as u64), &mut lengths[..]);
        let ranges = ranges_of(lengths.into_iter().map(|len| len as usize));
        let mut all = vec![0_u8; end_of(&ranges)];
        if !all.is_empty() {
            let (counts, starts) = counts(&ranges);
            self.world.all_gather_varcount_into(message, &mut PartitionMut::new(&mut all[..], counts, &starts[..]));
        }
        ranges.into_iter().map(|range| all[range].to_vec()).collect()
    }

    fn all_to_all(&self, values: &[f32], ranges: &[Range<usize>], num_senders: usize) -> Vec<f32> {
        let rank = self.rank();
        let own = ranges[rank].len();
        let sent = if rank < num_senders { ranges.to_vec() } else { vec![0..0; ranges.len()] };
        let received = ranges_of((0..ranges.len()).map(|sender| if sender < num_senders { own } else { 0 }));
        let mut all = vec![0.0; num_senders * own];
        if end_of(ranges) == 0 {
            return all;
        }
        let ((sent, sent_at), (got, got_at)) = (counts(&sent), counts(&received));
        self.world.all_to_all_varcount_into(
            &Partition::new(values, sent, &sent_at[..]),
            &mut PartitionMut::new(&mut all[..], got, &got_at[..]),
        );
        all
    }

    fn all_gather_values(&self, values: &mut [f32], ranges: &[Range<usize>]) {
        if values.is_empty() {
            return;
        }
        let own = values[ranges[self.rank()].clone()].to_vec();
        let (counts, starts) = counts(ranges);
        self.world.all_gather_varcount_into(&own[..], &mut PartitionMut::new(values, counts, &starts[..]));
    }
}
