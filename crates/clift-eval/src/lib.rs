//! Metrics, baselines, evaluation sweeps and their pictures

pub mod baseline;
pub mod error;
pub mod metrics;

pub use error::EvalError;
