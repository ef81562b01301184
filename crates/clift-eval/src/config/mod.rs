//! Evaluation settings.
//!
//! - `method`: rendering methods and baselines
//! - `token_selection`: the rule by which rendered tokens are selected
//! - `split`: the evaluated scenes and frames, and whether training has seen them
//! - `eval_config`: the `[eval]` section
//! - `experiment`: the paper's experiments as settings

pub(crate) mod eval_config;
pub(crate) mod experiment;
pub(crate) mod method;
pub(crate) mod split;
pub(crate) mod token_selection;
