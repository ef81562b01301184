//! What is evaluated, as the `[eval]` section of a config holds it.

use std::path::PathBuf;

use clift_model::TokenStorage;
use serde::{Deserialize, Serialize};

use crate::measured::Variant;
use crate::selection::Selection;
use crate::token_count::TokenCount;

/// Which scenes and views are rendered, with how many tokens.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct EvalConfig {
    /// Token counts a scene is stored with.
    pub storage: Vec<TokenCount>,
    /// Token counts a view is drawn from, numbers or shares of the stored ones, beside all of them: where they are
    /// fewer than are stored, every view is given tokens chosen for it.
    pub render: Vec<TokenCount>,
    /// How those are chosen: `paper`, `global`, `scaled` or `random`.
    pub selection: Selection,
    /// What is rendered, of `random`, `patch`, `patch_clift`, `kmeans` and `clift`; empty for all there are weights for.
    pub variants: Vec<Variant>,
    /// Number format that stored tokens are rounded to before they are rendered, as in a scene file.
    pub tokens: TokenStorage,
    /// Evaluation index with the context and target frames of every scene. Without one, contexts are
    /// spread evenly over each clip and targets lie between them.
    pub index: Option<PathBuf>,
    /// Most scenes that are evaluated; 0 for all.
    pub num_scenes: usize,
    /// Context views of a scene without an index.
    pub num_context: usize,
    /// Target views of a scene without an index.
    pub num_targets: usize,
    /// Scenes of which a picture sheet is written; the report shows them too, at most six.
    pub num_sheets: usize,
    /// Steps between validations during training; 0 for none.
    pub every: u64,
    /// Scenes of a validation.
    pub num_validation_scenes: usize,
    /// Token count of a stage-2 validation.
    pub validation_storage: TokenCount,
}

impl Default for EvalConfig {
    fn default() -> Self {
        // The ratios of the paper's main experiment.
        let shares = [1.0 / 16.0, 0.125, 0.25, 0.5, 0.75, 1.0];
        Self {
            storage: shares.map(TokenCount::Share).into(),
            render: Vec::new(),
            selection: Selection::default(),
            variants: Vec::new(),
            tokens: TokenStorage::F32,
            index: None,
            num_scenes: 0,
            num_context: 4,
            num_targets: 3,
            num_sheets: 4,
            every: 0,
            num_validation_scenes: 4,
            validation_storage: TokenCount::Share(0.125),
        }
    }
}
