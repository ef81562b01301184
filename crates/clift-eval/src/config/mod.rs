//! Evaluation settings.
//!
//! - `method`: rendering methods and baselines
//! - `token_selection`: token selection settings
//! - `split`: the evaluated scenes and frames, as related to training
//! - `eval_config`: the `[eval]` section
//! - `experiment`: the paper's experiments as settings

pub(crate) mod eval_config;
pub(crate) mod experiment;
pub(crate) mod method;
pub(crate) mod split;
pub(crate) mod token_selection;
