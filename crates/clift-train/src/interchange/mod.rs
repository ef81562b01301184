//! Published checkpoints in and out.
//!
//! - `record`: import options and import.json
//! - `keys`: network keys of a checkpoint
//! - `problems`: missing, unknown, misshapen keys
//! - `model_dir`: write a model directory
//! - `import`: published checkpoint to model directory
//! - `export`: model to PyTorch file

pub(crate) mod export;
pub(crate) mod import;
pub(crate) mod keys;
pub(crate) mod model_dir;
pub(crate) mod problems;
pub(crate) mod record;
