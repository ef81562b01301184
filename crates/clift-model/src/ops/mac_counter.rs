//! Counts the multiply-accumulates of layers and attention on a thread, in tests only.

use std::cell::Cell;

thread_local! {
    static LINEAR: Cell<u64> = const { Cell::new(0) };
    static ATTENTION: Cell<u64> = const { Cell::new(0) };
}

/// Adds a product of `[rows, inputs]` by `[inputs, outputs]`.
pub fn add_linear(rows: usize, inputs: usize, outputs: usize) {
    if cfg!(test) {
        LINEAR.set(LINEAR.get() + (rows * inputs * outputs) as u64);
    }
}

/// Adds the scores and weighted sums of `pairs` query-key pairs; `dim` is the width of all heads together.
pub fn add_attention(pairs: usize, dim: usize) {
    if cfg!(test) {
        ATTENTION.set(ATTENTION.get() + (2 * pairs * dim) as u64);
    }
}

/// Returns the counts since the last call: linear layers, attention.
#[cfg(test)]
pub fn take() -> (u64, u64) {
    (LINEAR.take(), ATTENTION.take())
}
