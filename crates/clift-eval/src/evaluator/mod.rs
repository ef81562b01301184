//! A complete evaluation and its files.
//!
//! - `items`: scenes and views to evaluate
//! - `progress`: receiver of progress
//! - `sheets`: contact sheets on disk, and file names of scenes
//! - `evaluator`: measure a model, write the results

pub(crate) mod evaluator;
pub(crate) mod items;
pub(crate) mod progress;
pub(crate) mod sheets;
