//! Evaluation of compressive light-field tokens: encode images, render views, measure quality and cost, write reports.
//!
//! [`encode`] compresses captured images to a scene. [`Evaluator`] measures trained models on test scenes with every method
//! and token count, and writes tables, contact sheets and an HTML report.
//!
//! The example `encode_and_render` encodes a folder of photos and renders a view.

mod codec;
mod config;
mod encode;
mod error;
mod evaluator;
mod figures;
mod report;
mod statistics;
mod sweep;
mod system;
#[cfg(test)]
mod testing;

// Errors of all functions.
pub use error::EvalError;

// Encode images.
pub use encode::{EncodeOptions, EncodedScene, encode, spread_contexts};

// The token codec of a model.
pub use codec::fit::{CodecOptions, FittedCodec, fit_codec};
pub use codec::step_choice::{expected_step, step_for_bytes, step_for_loss};

// Settings of an evaluation.
pub use config::eval_config::EvalConfig;
pub use config::experiment::Experiment;
pub use config::method::{Method, MethodName};
pub use config::split::{EvalFrames, EvalSplit};
pub use config::token_selection::Selection;

// A complete evaluation with its files.
pub use evaluator::evaluator::{Evaluator, SceneLimits, write_skip_report};
pub use evaluator::items::evaluation_items;
pub use evaluator::progress::{EvalProgress, Process, SharedScenes};
pub use report::page::RunDescription;
pub use report::training::TrainingCurve;

// One scene with every method and token count.
pub use sweep::eval_models::EvalModels;
pub use sweep::evaluate_scene::evaluate_scene;
pub use sweep::held_out_frame::HeldOutFrame;
pub use sweep::predictions::{ExternalMethod, file_name};
pub use sweep::rendered_views::SceneResults;
pub use sweep::sweep::Sweep;

// Results and comparisons.
pub use statistics::compare::{Comparison, Evaluation, MethodFilter};
pub use statistics::eval_results::EvalResults;
pub use statistics::summary::Summary;

// Figures and animations.
pub use figures::animation::Animation;
pub use figures::canvas::Canvas;
pub use figures::scene_figure::SceneFigures;
pub use figures::video::Video;

// The machine, for reports.
pub use system::machine::machine_rows;
pub use system::memory::{available_bytes, keep_freed_memory, peak_bytes, start_peak};
