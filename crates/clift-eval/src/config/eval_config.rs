//! What is evaluated, as the `[eval]` section of a config holds it.

use std::path::{Path, PathBuf};

use clift_model::{Precision, TokenCount, TokenFormat};
use serde::{Deserialize, Deserializer, Serialize};

use crate::config::method::Method;
use crate::config::token_selection::Selection;

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
    pub variants: Vec<Method>,
    /// Number formats that stored tokens are rounded to before they are rendered, as in a scene file: one, or a list of
    /// those to compare.
    #[serde(deserialize_with = "one_or_more")]
    pub tokens: Vec<TokenFormat>,
    /// Weights of LPIPS, converted by `scripts/tools/convert_vgg.py`; without them it is not measured.
    pub lpips_weights: Option<PathBuf>,
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
    /// What the operands of matrix products are when scenes are encoded, condensed and drawn: `f32` or `f16`. K-means is
    /// always f32.
    pub precision: Precision,
}

impl EvalConfig {
    /// The weights of LPIPS; none where the key is missing or empty.
    pub fn lpips_path(&self) -> Option<&Path> {
        self.lpips_weights.as_deref().filter(|path| !path.as_os_str().is_empty())
    }
}

/// A format or a list of them.
fn one_or_more<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<TokenFormat>, D::Error> {
    #[derive(Deserialize)]
    #[serde(untagged, expecting = "a format (\"f32\", \"f16\", \"int8\") or a list of them")]
    enum Written {
        One(TokenFormat),
        More(Vec<TokenFormat>),
    }
    let mut formats = match Written::deserialize(deserializer)? {
        Written::One(format) => vec![format],
        Written::More(formats) => formats,
    };
    let mut seen = Vec::new();
    formats.retain(|format| {
        !seen.contains(format) && {
            seen.push(*format);
            true
        }
    });
    if formats.is_empty() {
        return Err(serde::de::Error::custom("at least one format is needed"));
    }
    Ok(formats)
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
            tokens: vec![TokenFormat::F32],
            lpips_weights: None,
            index: None,
            num_scenes: 0,
            num_context: 4,
            num_targets: 3,
            num_sheets: 4,
            every: 0,
            num_validation_scenes: 4,
            validation_storage: TokenCount::Share(0.125),
            precision: Precision::F32,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn formats_are_one_or_a_list_each_once() {
        let tokens = |text: &str| serde_json::from_str::<EvalConfig>(text).map(|config| config.tokens);
        assert_eq!(tokens(r#"{"tokens": "f16"}"#).unwrap(), [TokenFormat::F16]);
        assert_eq!(tokens(r#"{"tokens": ["int8", "f32", "int8"]}"#).unwrap(), [TokenFormat::Int8, TokenFormat::F32]);
        assert!(tokens(r#"{"tokens": []}"#).unwrap_err().to_string().contains("at least one"));
        assert!(tokens(r#"{"tokens": "f64"}"#).unwrap_err().to_string().contains("int8"));
    }

    #[test]
    fn an_empty_path_takes_the_weights_away() {
        let config = |path: &str| EvalConfig { lpips_weights: Some(path.into()), ..EvalConfig::default() };
        assert_eq!(config("").lpips_path(), None);
        assert_eq!(config("a").lpips_path(), Some(Path::new("a")));
    }
}
