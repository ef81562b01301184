//! Metrics, baselines, evaluation sweeps and their pictures

pub mod animation;
pub mod baseline;
pub mod budget;
pub mod config;
pub mod error;
pub mod evaluate;
pub mod measured;
pub mod metrics;
pub mod picture;
pub mod sheet;
pub mod summary;
pub mod token_count;
pub mod upload;

pub use animation::Animation;
pub use budget::Calibration;
pub use config::EvalConfig;
pub use error::EvalError;
pub use evaluate::{Networks, Sweep, evaluate_scene};
pub use measured::{Accumulator, Variant};
pub use summary::Summary;
pub use token_count::TokenCount;
pub use upload::{upload_cameras, upload_pictures, upload_views};
