//! The two-stage trainer: stage 1, cluster cache, stage 2, checkpoints and resume

pub mod diagnostic;
pub mod document;
pub mod events;
mod keys;
mod mistakes;
mod overrides;
pub mod schedule;
pub mod sinks;

pub use document::{ConfigError, Override, read_config};
