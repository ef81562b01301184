//! Metrics, baselines, evaluation sweeps and their pictures

pub mod animation;
pub mod baseline;
pub mod budget;
pub mod config;
pub mod error;
pub mod evaluate;
pub mod exhibit;
pub mod machine;
pub mod measured;
pub mod metrics;
pub mod paired;
pub mod picture;
pub mod preset;
mod rendered;
pub mod report;
pub mod selection;
pub mod sheet;
mod stored;
pub mod summary;
pub mod token_count;
pub mod upload;

pub use animation::Animation;
pub use budget::Calibration;
pub use config::EvalConfig;
pub use error::EvalError;
pub use evaluate::{Networks, Sweep, evaluate_scene};
pub use exhibit::{Exhibit, Shown};
pub use measured::{Accumulator, Variant};
pub use paired::Difference;
pub use preset::Experiment;
pub use report::Report;
pub use selection::Selection;
pub use summary::Summary;
pub use token_count::TokenCount;
pub use upload::{upload_cameras, upload_pictures, upload_views, view_cameras};
