//! Options of a benchmark.

use std::path::PathBuf;

use clift_model::TokenCount;

use crate::cases::case::BenchCase;

/// Most tokens, over all scenes of a batch, of an update whose gradient is compared with f64. At full size the f64
/// reference would take twice the memory of the timed update and several times as long.
pub const MAX_CHECKED_TOKENS: usize = 1024;

/// Cases to time and their sizes.
#[derive(Clone, Debug)]
pub struct BenchOptions {
    /// The cases, in any order; they run in that of [`BenchCase::ALL`].
    pub cases: Vec<BenchCase>,
    /// Timed repetitions, at least 1.
    pub repeats: usize,
    /// Warm-up repetitions.
    pub warmup: usize,
    /// Whether results are compared with f64.
    pub error: bool,
    /// Stored tokens of a scene.
    pub storage: TokenCount,
    /// Tokens from which a view is rendered; `None` for all of a scene.
    pub render: Option<TokenCount>,
    /// Input of K-means: a safetensors file with the tensor `features`, `[N, D]` in f32; `None` for the encoder's tokens.
    pub features: Option<PathBuf>,
}

impl BenchOptions {
    /// One timed repetition of each case, without warm-up and f64 check, with all tokens stored.
    pub fn new(cases: Vec<BenchCase>) -> Self {
        let storage = TokenCount::Share(1.0);
        Self { cases, repeats: 1, warmup: 0, error: false, storage, render: None, features: None }
    }
}
