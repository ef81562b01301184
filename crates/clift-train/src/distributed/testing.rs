//! Ranks as threads of one process.

use std::ops::Range;
use std::sync::mpsc::{Receiver, Sender, channel};

use crate::distributed::ranks::{Communicator, Ranks};

/// A rank with a channel to and from every rank.
struct ThreadRank {
    rank: usize,
    to: Vec<Sender<Vec<u8>>>,
    from: Vec<Receiver<Vec<u8>>>,
}

impl ThreadRank {
    fn exchange(&self, message_to: impl Fn(usize) -> Vec<u8>) -> Vec<Vec<u8>> {
        for (rank, to) in self.to.iter().enumerate() {
            to.send(message_to(rank)).expect("the other rank is there");
        }
        self.from.iter().map(|from| from.recv().expect("the other rank is there")).collect()
    }
}

fn to_bytes(values: &[f32]) -> Vec<u8> {
    values.iter().flat_map(|value| value.to_le_bytes()).collect()
}

fn to_values(bytes: &[u8]) -> impl Iterator<Item = f32> {
    bytes.as_chunks::<4>().0.iter().map(|bytes| f32::from_le_bytes(*bytes))
}

impl Communicator for ThreadRank {
    fn rank(&self) -> usize {
        self.rank
    }

    fn num_ranks(&self) -> usize {
        self.to.len()
    }

    fn all_gather(&self, message: &[u8]) -> Vec<Vec<u8>> {
        self.exchange(|_| message.to_vec())
    }

    fn all_to_all(&self, values: &[f32], ranges: &[Range<usize>], num_senders: usize) -> Vec<f32> {
        let sends = self.rank < num_senders;
        let all = self.exchange(|rank| if sends { to_bytes(&values[ranges[rank].clone()]) } else { Vec::new() });
        all.iter().flat_map(|bytes| to_values(bytes)).collect()
    }

    fn all_gather_values(&self, values: &mut [f32], ranges: &[Range<usize>]) {
        let own = to_bytes(&values[ranges[self.rank].clone()]);
        for (range, bytes) in ranges.iter().zip(self.exchange(|_| own.clone())) {
            values[range.clone()].iter_mut().zip(to_values(&bytes)).for_each(|(to, from)| *to = from);
        }
    }
}

/// Runs `work` on `num_ranks` ranks, and returns the results by rank. A panic of one ends all.
pub fn on_threads<T: Send>(num_ranks: usize, work: impl Fn(Ranks) -> T + Sync) -> Vec<T> {
    let mut ends: Vec<_> = (0..num_ranks).map(|rank| ThreadRank { rank, to: Vec::new(), from: Vec::new() }).collect();
    for from in 0..num_ranks {
        for to in 0..num_ranks {
            let (sender, receiver) = channel();
            ends[from].to.push(sender);
            ends[to].from.push(receiver);
        }
    }
    let work = &work;
    std::thread::scope(|scope| {
        let start = |end: ThreadRank| scope.spawn(move || work(Ranks::new(end)));
        let threads: Vec<_> = ends.into_iter().map(start).collect();
        threads.into_iter().map(|thread| thread.join().expect("no rank panics")).collect()
    })
}
