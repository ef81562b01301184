//! Division of rows among tasks, by shape alone: sums do not depend on the number of threads.

/// Values per task: a piece of each slice that stays in the cache.
pub(crate) const PIECE: usize = 1 << 14;

/// Most parts of rows that are summed separately.
const MAX_PARTS: usize = 64;

pub(crate) fn rows_per_task(width: usize) -> usize {
    PIECE.div_ceil(width)
}

/// Returns the rows per task where every task has sums of its own.
pub(crate) fn rows_per_sum(rows: usize, width: usize) -> usize {
    rows.div_ceil(MAX_PARTS).max(rows_per_task(width))
}

/// Computes `to += from`.
pub(crate) fn add(from: &[f32], to: &mut [f32]) {
    to.iter_mut().zip(from).for_each(|(to, value)| *to += value);
}
