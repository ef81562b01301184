//! Import of published checkpoints, and model directories in f16.
//!
//! - `keys`: network keys of a checkpoint
//! - `problems`: missing, unknown, misshapen keys
//! - `model_dir`: write a model directory
//! - `export`: model directory in f16
//! - `import`: published checkpoint to model directory; its options and record

pub(crate) mod export;
pub(crate) mod import;
pub(crate) mod keys;
pub(crate) mod model_dir;
pub(crate) mod problems;
