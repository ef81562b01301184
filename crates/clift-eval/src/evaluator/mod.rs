//! A complete evaluation and its files.
//!
//! - `progress`: progress interface
//! - `items`: scenes and views to evaluate
//! - `sheets`: contact sheets on disk
//! - `evaluator`: measure a model, write the results

pub(crate) mod evaluator;
pub(crate) mod items;
pub(crate) mod progress;
pub(crate) mod sheets;
