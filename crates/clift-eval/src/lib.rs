//! Metrics, baselines, evaluation sweeps and their pictures

pub mod baseline;
pub mod error;
pub mod measured;
pub mod metrics;
pub mod picture;
pub mod sheet;
pub mod summary;

pub use error::EvalError;
