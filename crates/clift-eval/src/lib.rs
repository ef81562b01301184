//! Metrics, baselines, evaluation sweeps and their pictures

pub mod baseline;
pub mod error;
pub mod metrics;
pub mod picture;
pub mod sheet;

pub use error::EvalError;
