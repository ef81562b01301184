//! A complete evaluation and its files.
//!
//! - `items`: scenes and views to evaluate
//! - `progress`: progress, and the processes that share the scenes
//! - `sheets`: contact sheets on disk
//! - `evaluator`: measure a model, write the results

pub(crate) mod evaluator;
pub(crate) mod items;
pub(crate) mod progress;
pub(crate) mod sheets;
