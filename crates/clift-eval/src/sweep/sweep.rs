//! Settings of a sweep over methods and token counts.

use clift_model::{KMeans, ModelConfig, TokenCount, TokenFormat};

use crate::config::method::Method;
use crate::config::token_selection::Selection;
use crate::metrics::lpips::Lpips;
use crate::sweep::predictions::ExternalMethod;

/// Settings of a sweep.
#[derive(Clone, Debug)]
pub struct Sweep {
    /// Token counts of the stored scene.
    pub storage: Vec<TokenCount>,
    /// Token counts of a rendered view, beside all stored tokens: numbers, or shares of the stored tokens. Counts that are
    /// not below the stored count are ignored.
    pub render: Vec<TokenCount>,
    /// Selection of the rendered tokens.
    pub selection: Selection,
    /// Number formats of the stored tokens, as in a scene file, each measured. Random subsets stay f32. Images are kept of
    /// the first format.
    pub tokens: Vec<TokenFormat>,
    /// Rendered methods: all of [`EvalModels::methods`](crate::sweep::eval_models::EvalModels::methods), or fewer.
    pub methods: Vec<Method>,
    /// Latent K-means.
    pub kmeans: KMeans,
    /// Sizes of the networks.
    pub model: ModelConfig,
    /// LPIPS; `None` without its weights.
    pub lpips: Option<Lpips>,
    /// Methods of other programs, given by their images.
    pub external_methods: Vec<ExternalMethod>,
    /// Whether the device is a CPU, where the peak memory of the process includes the tensors.
    pub is_cpu: bool,
    /// Seed of K-means and of random tokens. Every scene derives a seed of its own from this seed and its key.
    pub seed: u64,
}

impl Sweep {
    /// Returns the token count of every rendering of a target view in a scene of `num_storage_tokens`.
    pub fn token_counts(&self, num_storage_tokens: usize) -> Vec<usize> {
        let counts = [vec![num_storage_tokens], self.render_counts(num_storage_tokens)].concat();
        let num_formats: usize = self.methods.iter().map(|&method| self.formats(method).len()).sum();
        counts.repeat(num_formats)
    }

    /// Returns the render counts below `num_storage_tokens`, ascending.
    pub(crate) fn render_counts(&self, num_storage_tokens: usize) -> Vec<usize> {
        let counts = self.render.iter().filter_map(|count| count.of(num_storage_tokens).ok());
        let mut counts: Vec<usize> = counts.filter(|&count| count < num_storage_tokens).collect();
        counts.sort_unstable();
        counts.dedup();
        counts
    }

    /// Returns the number formats of a method.
    pub(crate) fn formats(&self, method: Method) -> &[TokenFormat] {
        if method == Method::Random { &[TokenFormat::F32] } else { &self.tokens }
    }
}

#[cfg(test)]
mod tests {
    use clift_model::SelectionPreset;

    use super::*;

    #[test]
    fn render_counts_are_distinct_and_below_storage() {
        let sweep = Sweep {
            storage: Vec::new(),
            render: vec![
                TokenCount::Count(16),
                TokenCount::Share(0.5),
                TokenCount::Count(64),
                TokenCount::Share(1.0),
                TokenCount::Count(4),
            ],
            selection: Selection::Preset(SelectionPreset::Paper),
            tokens: vec![TokenFormat::F32],
            methods: Vec::new(),
            kmeans: KMeans::default(),
            model: ModelConfig::default(),
            lpips: None,
            external_methods: Vec::new(),
            is_cpu: true,
            seed: 0,
        };
        assert_eq!(sweep.render_counts(128), [4, 16, 64]);
        assert_eq!(sweep.render_counts(32), [4, 16]);
        assert_eq!(sweep.render_counts(2), [1]);
        assert_eq!(sweep.render_counts(1), [0; 0]);
    }
}
