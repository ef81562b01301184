//! `clift bench allreduce`: time and bandwidth of the sum over ranks.

use std::time::Instant;

use clift_core::{median, p95};
use clift_train::{Ranks, TrainError, sent_bytes};
use serde::Serialize;

/// The measured sum over ranks.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct AllReduceReport {
    /// Number of ranks.
    pub num_ranks: usize,
    /// Median seconds of a short message from every rank to every rank.
    pub message_s: f64,
    /// A row per size.
    pub rows: Vec<AllReduceRow>,
}

/// The sum of vectors of one size.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct AllReduceRow {
    /// Number of summed values.
    pub num_values: usize,
    /// Median seconds until rank 0 has the sum.
    pub median_s: f64,
    /// 95th percentile of the seconds.
    pub p95_s: f64,
    /// Bytes that a rank sends to others.
    pub sent_bytes: u64,
}

impl AllReduceRow {
    /// Returns the sent bytes per second, in units of 1e9.
    pub fn gb_per_s(&self) -> f64 {
        self.sent_bytes as f64 / self.median_s / 1e9
    }
}

/// Sums vectors of each size over the ranks, `repeats` times after one warm-up, and checks the sums.
///
/// # Errors
/// [`TrainError::RanksDiffer`] for a wrong sum, and those of the other ranks.
pub fn measure_allreduce(ranks: &Ranks, sizes: &[usize], repeats: usize) -> Result<AllReduceReport, TrainError> {
    let num_ranks = ranks.num_ranks();
    let mut messages = Vec::with_capacity(repeats);
    for _ in 0..=repeats {
        let started = Instant::now();
        ranks.any(false)?;
        messages.push(started.elapsed().as_secs_f64());
    }
    let mut rows = Vec::with_capacity(sizes.len());
    for &num_values in sizes {
        // Small whole numbers: their sum is exact.
        let value = |rank: usize, i: usize| ((i + rank) % 1000) as f32;
        let own: Vec<f32> = (0..num_values).map(|i| value(ranks.rank(), i)).collect();
        let mut seconds = Vec::with_capacity(repeats);
        for _ in 0..=repeats {
            ranks.any(false)?;
            let started = Instant::now();
            let sum = ranks.sum(&own)?;
            seconds.push(started.elapsed().as_secs_f64());
            let expected = |i: usize| (0..num_ranks).map(|rank| value(rank, i)).sum::<f32>();
            if sum.iter().enumerate().any(|(i, &sum)| sum != expected(i)) {
                return Err(TrainError::RanksDiffer { what: "the sums", rank: ranks.rank() });
            }
        }
        let (median_s, p95_s) = (median(&seconds[1..]), p95(&seconds[1..]));
        rows.push(AllReduceRow { num_values, median_s, p95_s, sent_bytes: sent_bytes(num_values as u64, num_ranks) });
    }
    Ok(AllReduceReport { num_ranks, message_s: median(&messages[1..]), rows })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_process_sums_without_sending() {
        let report = measure_allreduce(&Ranks::single(), &[0, 1, 1000], 2).unwrap();
        assert_eq!(report.rows.iter().map(|row| row.sent_bytes).collect::<Vec<_>>(), [0, 0, 0]);
        assert!(report.rows.iter().all(|row| row.median_s <= row.p95_s));
    }
}
