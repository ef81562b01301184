//! Evaluation settings.
//!
//! - `method`: rendering methods and baselines
//! - `token_selection`: token selection settings
//! - `eval_config`: the `[eval]` section
//! - `experiment`: the paper's experiments as settings

pub(crate) mod eval_config;
pub(crate) mod experiment;
pub(crate) mod method;
pub(crate) mod token_selection;
