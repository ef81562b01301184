//! Timing options.

use std::path::PathBuf;

use clift_model::TokenCount;

use crate::cases::case::BenchCase;

/// Most tokens, over all scenes of a batch, of the smaller update whose gradient is compared with f64.
///
/// At full size f64 would take twice the memory of the update that is timed, and a few times as long.
pub const MAX_CHECKED_TOKENS: usize = 1024;

/// What is timed, and how.
#[derive(Clone, Debug)]
pub struct BenchOptions {
    /// The rows; [`BenchCase::ALL`] gives them their order.
    pub work: Vec<BenchCase>,
    /// Repetitions that count, at least 1.
    pub repeats: usize,
    /// Repetitions before them that do not.
    pub warmup: usize,
    /// Whether results are compared with f64.
    pub error: bool,
    /// Tokens that are stored.
    pub storage: TokenCount,
    /// Tokens that a view is drawn from; `None` for all of a scene.
    pub render: Option<TokenCount>,
    /// A safetensors file whose tensor `features`, `[N, D]` in f32, K-means clusters.
    pub features: Option<PathBuf>,
}
