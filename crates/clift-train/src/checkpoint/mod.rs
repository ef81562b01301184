//! Saved state of a stage.
//!
//! - `progress`: state.json of a checkpoint
//! - `checkpoints`: save, resume, keep the newest
//! - `newest`: the model of a run that is still training

pub(crate) mod checkpoints;
pub(crate) mod newest;
pub(crate) mod progress;
