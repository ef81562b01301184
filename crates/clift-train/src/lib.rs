//! The two-stage trainer: stage 1, cluster cache, stage 2, checkpoints and resume

pub mod diagnostic;
pub mod document;
mod keys;
mod mistakes;
mod overrides;

pub use document::{ConfigError, Override, read_config};
