//! Saved state of a stage.
//!
//! - `progress`: state.json of a checkpoint
//! - `checkpoints`: save, resume, keep the best

pub(crate) mod checkpoints;
pub(crate) mod progress;
