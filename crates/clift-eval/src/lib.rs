//! Metrics, baselines, evaluation sweeps and their pictures

mod config;
mod encode;
mod error;
mod evaluator;
mod figures;
mod metrics;
mod report;
mod statistics;
mod sweep;
mod system;
#[cfg(test)]
mod testing;
mod upload;

pub use config::eval_config::EvalConfig;
pub use config::experiment::Experiment;
pub use config::method::{Method, MethodName};
pub use config::token_selection::Selection;
pub use encode::{EncodeOptions, Encoded, encode};
pub use error::EvalError;
pub use evaluator::evaluator::{Description, Evaluator, Limits, write_ledger};
pub use evaluator::items::evaluation_items;
pub use evaluator::progress::Progress;
pub use figures::animation::Animation;
pub use figures::canvas::Canvas;
pub use figures::scene_figure::{SceneFigure, SceneFigures};
pub use metrics::image_metrics::{psnr, ssim};
pub use metrics::lpips::{LPIPS_COMMAND, LPIPS_MIN_SIZE_PX, Lpips};
pub use metrics::perceptual::{PERCEPTUAL_COMMAND, PERCEPTUAL_MIN_SIZE_PX, Perceptual};
pub use metrics::vgg::VggShape;
pub use report::page::Report;
pub use statistics::compare::{Comparison, Evaluation, MethodFilter};
pub use statistics::eval_results::EvalResults;
pub use statistics::paired::PairedDifference;
pub use statistics::summary::Summary;
pub use statistics::view_metrics::{EvalKey, ViewMetrics};
pub use sweep::eval_models::{EvalModels, stage2_method};
pub use sweep::evaluate_scene::evaluate_scene;
pub use sweep::predictions::ExternalMethod;
pub use sweep::scene_results::SceneResults;
pub use sweep::sweep::Sweep;
pub use system::machine::rows as machine_rows;
pub use system::memory::{available_bytes, peak_bytes, start_peak};
pub use upload::{upload_cameras, upload_images, upload_views, view_cameras};
