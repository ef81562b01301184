//! Evaluation of compressive light-field tokens: render views, measure quality and cost, write reports.
//!
//! [`Evaluator`] measures trained models on test scenes with every method
//! and token count, and writes tables, contact sheets and an HTML report.

// The JSON of a summary in a test.
#![cfg_attr(test, recursion_limit = "256")]

mod config;
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

// Settings of an evaluation.
pub use config::eval_config::EvalConfig;
pub use config::experiment::Experiment;
pub use config::method::Method;
pub use config::split::{EvalFrames, EvalSplit};
pub use config::token_selection::Selection;

// A complete evaluation with its files.
pub use evaluator::evaluator::{EvalEvent, Evaluator, SceneLimits, write_skip_report};
pub use evaluator::items::evaluation_items;
pub use evaluator::sheets::file_name;
pub use report::page::RunDescription;

// One scene with every method and token count.
pub use sweep::eval_models::EvalModels;
pub use sweep::sweep::Sweep;

// Results and comparisons.
pub use statistics::compare::{Comparison, Evaluation};
pub use statistics::eval_results::EvalResults;
pub use statistics::summary::{Summary, training_scenes_note};
pub use statistics::text_table::table;

// Figures and animations.
pub use figures::animation::Animation;
pub use figures::canvas::Canvas;

// The machine, for reports.
pub use system::machine::machine_rows;
pub use system::memory::{available_bytes, keep_freed_memory, peak_bytes, start_peak};
