//! Settings of a sweep over methods and token counts.

use clift_model::{KMeans, Lpips, ModelConfig, TokenCount};
use clift_scene::TokenCoding;

use crate::config::method::Method;
use crate::config::token_selection::Selection;
use crate::sweep::predictions::ExternalMethod;

/// Settings of a sweep.
#[derive(Clone, Debug)]
pub struct Sweep {
    /// Token counts of the stored scene.
    pub stored_tokens: Vec<TokenCount>,
    /// Token counts of a rendered view, beside all stored tokens: numbers, or shares of the stored tokens. Counts that are
    /// not below the stored count are ignored.
    pub render: Vec<TokenCount>,
    /// Selection of the rendered tokens.
    pub selection: Selection,
    /// Number formats of the stored tokens, as in a scene file, each measured. Random subsets stay f32. Images are kept of
    /// the first format.
    pub formats: Vec<TokenCoding>,
    /// Rendered methods: all of [`EvalModels::methods`](crate::sweep::eval_models::EvalModels::methods), or fewer.
    pub methods: Vec<Method>,
    /// Path of the model in scene files, for the size of a coded file.
    pub model_path: String,
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
    /// Least number of timed views per key: views of the first scenes are rendered again to reach it. 0 renders every view once.
    pub min_timed_views: usize,
    /// Seed of K-means and of random tokens. Every scene derives a seed of its own from this seed and its key.
    pub seed: u64,
}

impl Sweep {
    /// Returns the token count of every rendering of a target view in a scene of `num_storage_tokens`.
    pub fn token_counts(&self, num_storage_tokens: usize) -> Vec<usize> {
        let counts = [vec![num_storage_tokens], render_counts(&self.render, num_storage_tokens)].concat();
        let num_formats: usize = self.methods.iter().map(|&method| self.formats(method).len()).sum();
        counts.repeat(num_formats)
    }

    /// Returns the formats of a method: random tokens have no file, and the codec is that of condensed tokens.
    pub(crate) fn formats(&self, method: Method) -> Vec<TokenCoding> {
        let is_plain = |tokens: &TokenCoding| matches!(tokens, TokenCoding::Plain(_));
        let formats: Vec<TokenCoding> = match method {
            Method::Clift => self.formats.clone(),
            Method::Random => Vec::new(),
            _ => self.formats.iter().copied().filter(is_plain).collect(),
        };
        if formats.is_empty() { vec![TokenCoding::F32] } else { formats }
    }
}

/// Returns the counts of `render` below `num_storage_tokens`, ascending.
pub(crate) fn render_counts(render: &[TokenCount], num_storage_tokens: usize) -> Vec<usize> {
    let counts = render.iter().filter_map(|count| count.of(num_storage_tokens).ok());
    let mut counts: Vec<usize> = counts.filter(|&count| count < num_storage_tokens).collect();
    counts.sort_unstable();
    counts.dedup();
    counts
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn render_counts_are_distinct_and_below_storage() {
        let (count, share) = (TokenCount::Count, TokenCount::Share);
        let render = [count(16), share(0.5), count(64), share(1.0), count(4)];
        let cases: [(usize, &[usize]); 4] = [(128, &[4, 16, 64]), (32, &[4, 16]), (2, &[1]), (1, &[])];
        for (num_storage_tokens, expected) in cases {
            assert_eq!(render_counts(&render, num_storage_tokens), expected);
        }
    }
}
