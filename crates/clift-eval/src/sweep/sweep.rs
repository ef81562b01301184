//! Settings of a sweep over methods and token counts.

use clift_model::{KMeans, Lpips, ModelConfig};

use crate::config::eval_config::EvalConfig;

/// Settings of a sweep.
#[derive(Clone, Debug)]
pub struct Sweep {
    /// Token counts, formats, methods and selection. Counts of `render` that are not below the stored count are ignored.
    /// Images are kept of the first format. The methods are all of
    /// [`EvalModels::methods`](crate::sweep::eval_models::EvalModels::methods), or fewer.
    pub eval: EvalConfig,
    /// Path of the model in scene files, for the size of a coded file.
    pub model_path: String,
    /// Latent K-means.
    pub kmeans: KMeans,
    /// Sizes of the networks.
    pub model: ModelConfig,
    /// LPIPS; `None` without its weights.
    pub lpips: Option<Lpips>,
    /// Whether the device is a CPU, where the peak memory of the process includes the tensors.
    pub is_cpu: bool,
    /// Whether the context views are rendered too, to find those that come out as fog.
    pub checks_contexts: bool,
    /// Seed of K-means and of random tokens. Every scene derives a seed of its own from this seed and its key.
    pub seed: u64,
}
