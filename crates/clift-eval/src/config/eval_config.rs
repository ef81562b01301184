//! The `[eval]` section of a config.

use std::path::{Path, PathBuf};

use clift_model::{Precision, TokenCount};
use clift_scene::TokenCoding;
use serde::{Deserialize, Serialize};

use crate::config::method::Method;
use crate::config::token_selection::Selection;

/// Scenes, views, methods and token counts of an evaluation.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct EvalConfig {
    /// Token counts of the stored scenes.
    pub stored_tokens: Vec<TokenCount>,
    /// Token counts of a rendered view, numbers or shares of the stored tokens, beside all stored tokens. Below the
    /// stored count, tokens are selected for every view.
    pub render: Vec<TokenCount>,
    /// Token selection: `paper`, `global`, `scaled` or `random`.
    pub selection: Selection,
    /// Rendered methods of `random`, `tile`, `tile_clift`, `kmeans`, `clift` and `lvsm_ed`; empty for all methods with
    /// weights.
    pub methods: Vec<Method>,
    /// Formats of the stored tokens, as in a scene file, to compare: `f32`, `f16`, `coded` (at most 0.02 dB of loss as
    /// measured when the codec was fitted) and `coded-DB`.
    pub formats: Vec<TokenCoding>,
    /// LPIPS weights, converted by `scripts/tools/convert_vgg.py`. LPIPS is not measured without weights.
    pub lpips_weights: Option<PathBuf>,
    /// Evaluation index with the context and target frames of every scene. Without an index, contexts are spread evenly
    /// over a scene, with targets between the contexts (held-out frames, where `data.hold_out` applies).
    pub index: Option<PathBuf>,
    /// Whether targets of the index that are also contexts are left out: the input holds their images.
    pub drop_context_targets: bool,
    /// Largest number of evaluated scenes; 0 for all.
    pub num_scenes: usize,
    /// Context views of a scene without an index.
    pub num_context: usize,
    /// Target views of a scene without an index.
    pub num_targets: usize,
    /// Number of scenes with a contact sheet. The report shows the first six.
    pub num_sheets: usize,
    /// Steps between validations during training; 0 for no validation.
    pub every: u64,
    /// Scenes of a validation.
    pub num_validation_scenes: usize,
    /// Token count of a stage-2 validation.
    pub validation_stored_tokens: TokenCount,
    /// Precision of matrix products in encoder, condenser and renderer: `f32`, `bf16` or `f16`. K-means is always f32.
    pub precision: Precision,
}

impl EvalConfig {
    /// Returns the LPIPS weights; `None` if the key is missing or empty.
    pub fn lpips_path(&self) -> Option<&Path> {
        self.lpips_weights.as_deref().filter(|path| !path.as_os_str().is_empty())
    }

    /// Returns the token counts of the renderings of a target view in a scene of `num_storage_tokens`, over all methods and
    /// formats.
    pub fn token_counts(&self, num_storage_tokens: usize) -> Vec<usize> {
        let counts = [vec![num_storage_tokens], self.render_counts(num_storage_tokens)].concat();
        let num_formats: usize = self.methods.iter().map(|&method| self.formats_of(method).len()).sum();
        counts.repeat(num_formats)
    }

    /// Returns the formats of a method: random tokens have no file, and the codec is that of condensed tokens.
    pub(crate) fn formats_of(&self, method: Method) -> Vec<TokenCoding> {
        let is_plain = |tokens: &TokenCoding| matches!(tokens, TokenCoding::Plain(_));
        let formats: Vec<TokenCoding> = match method {
            Method::Clift => self.formats.clone(),
            Method::Random => Vec::new(),
            _ => self.formats.iter().copied().filter(is_plain).collect(),
        };
        if formats.is_empty() { vec![TokenCoding::F32] } else { formats }
    }

    /// Returns the counts of `render` below `num_storage_tokens`, ascending.
    pub(crate) fn render_counts(&self, num_storage_tokens: usize) -> Vec<usize> {
        let counts = self.render.iter().filter_map(|count| count.of(num_storage_tokens).ok());
        let mut counts: Vec<usize> = counts.filter(|&count| count < num_storage_tokens).collect();
        counts.sort_unstable();
        counts.dedup();
        counts
    }
}

impl Default for EvalConfig {
    fn default() -> Self {
        // The shares of the paper's main experiment.
        let shares = [1.0 / 16.0, 0.125, 0.25, 0.5, 0.75, 1.0];
        Self {
            stored_tokens: shares.map(TokenCount::Share).into(),
            render: Vec::new(),
            selection: Selection::default(),
            methods: Vec::new(),
            formats: vec![TokenCoding::F32],
            lpips_weights: None,
            index: None,
            drop_context_targets: false,
            num_scenes: 0,
            num_context: 4,
            num_targets: 3,
            num_sheets: 4,
            every: 0,
            num_validation_scenes: 4,
            validation_stored_tokens: TokenCount::Share(0.125),
            precision: Precision::F32,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn render_counts_are_distinct_and_below_storage() {
        let (count, share) = (TokenCount::Count, TokenCount::Share);
        let render = vec![count(16), share(0.5), count(64), share(1.0), count(4)];
        let eval = EvalConfig { render, ..EvalConfig::default() };
        let cases: [(usize, &[usize]); 4] = [(128, &[4, 16, 64]), (32, &[4, 16]), (2, &[1]), (1, &[])];
        for (num_storage_tokens, expected) in cases {
            assert_eq!(eval.render_counts(num_storage_tokens), expected);
        }
    }
}
