//! Blockwise softmax attention: a block of queries against a block of keys at a time, both in the cache, without a
//! matrix of all scores (Dao et al. 2022, "`FlashAttention`").
//!
//! Heads are read in place, by stride, from rows that may be part of wider rows (packed projections); every task copies
//! its head once into a contiguous block.
//!
//! - `shapes`: sizes, strided rows and blocks of a head
//! - `forward`: output and log sums
//! - `backward`: gradients of queries, keys and values

pub(crate) mod backward;
pub(crate) mod forward;
pub(crate) mod shapes;
