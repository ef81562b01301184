//! A complete evaluation and its files.
//!
//! - `items`: scenes and views to evaluate
//! - `sheets`: contact sheets on disk, and file names of scenes
//! - `evaluator`: measure a model, write the results

pub(crate) mod evaluator;
pub(crate) mod items;
pub(crate) mod sheets;
