//! Settings of an evaluation of a scene.

use clift_model::{KMeans, ModelConfig, TokenCount, TokenFormat};

use crate::config::method::Method;
use crate::config::token_selection::Selection;
use crate::metrics::lpips::Lpips;
use crate::sweep::predictions::ExternalMethod;

/// Settings of a sweep.
#[derive(Clone, Debug)]
pub struct Sweep {
    /// Token counts a scene is stored with.
    pub storage: Vec<TokenCount>,
    /// Token counts a view is drawn from beside all that are stored, of these; those that are not fewer are left out.
    pub render: Vec<TokenCount>,
    /// How fewer tokens are chosen.
    pub selection: Selection,
    /// Number formats that stored tokens are rounded to, as in a scene file, one after the other. Random subsets have
    /// no file and are not rounded. Pictures are shown of the first.
    pub tokens: Vec<TokenFormat>,
    /// Which variants are rendered: those of [`EvalModels::methods`](crate::sweep::eval_models::EvalModels::methods), or fewer.
    pub variants: Vec<Method>,
    /// Latent K-means.
    pub kmeans: KMeans,
    /// Sizes of the networks.
    pub model: ModelConfig,
    /// LPIPS, where its weights are there.
    pub lpips: Option<Lpips>,
    /// Other systems' pictures.
    pub systems: Vec<ExternalMethod>,
    /// Whether tensors live in this process's memory, so that its peak says something.
    pub is_cpu: bool,
    /// Seed of K-means and of what is random; each scene derives its own from it and its key.
    pub seed: u64,
}

impl Sweep {
    /// Tokens that a target is drawn from, for every time it is drawn where a scene has `num_storage_tokens`.
    pub fn drawn(&self, num_storage_tokens: usize) -> Vec<usize> {
        let counts = [vec![num_storage_tokens], self.render_counts(num_storage_tokens)].concat();
        let num_formats: usize = self.variants.iter().map(|&variant| self.formats(variant).len()).sum();
        counts.repeat(num_formats)
    }

    /// Counts that views are drawn from where a scene has `num_storage_tokens`: fewer than those, rising.
    pub(crate) fn render_counts(&self, num_storage_tokens: usize) -> Vec<usize> {
        let counts = self.render.iter().filter_map(|count| count.of(num_storage_tokens).ok());
        let mut counts: Vec<usize> = counts.filter(|&count| count < num_storage_tokens).collect();
        counts.sort_unstable();
        counts.dedup();
        counts
    }

    pub(crate) fn formats(&self, variant: Method) -> &[TokenFormat] {
        if variant == Method::Random { &[TokenFormat::F32] } else { &self.tokens }
    }
}

#[cfg(test)]
mod tests {
    use clift_model::SelectionPreset;

    use super::*;

    #[test]
    fn views_are_drawn_from_fewer_tokens_than_are_stored_each_count_once() {
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
            variants: Vec::new(),
            kmeans: KMeans::default(),
            model: ModelConfig::default(),
            lpips: None,
            systems: Vec::new(),
            is_cpu: true,
            seed: 0,
        };
        assert_eq!(sweep.render_counts(128), [4, 16, 64]);
        assert_eq!(sweep.render_counts(32), [4, 16]);
        assert_eq!(sweep.render_counts(2), [1]);
        assert_eq!(sweep.render_counts(1), [0; 0]);
    }
}
