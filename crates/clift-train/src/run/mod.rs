//! A run directory from open to report.
//!
//! - `lock`: lock of a run directory or an output folder
//! - `eval_folder`: output folder of an evaluation
//! - `logs`: metrics, skipped steps and scenes as JSONL
//! - `run_file`: run.json; same settings on resume; the data that a run was trained on
//! - `validation`: validation and evaluation
//! - `train_loop`: settings, batches and folder of a stage; resume or start it; step, save, validate
//! - `init_from`: initial weights of a stage, and weights between those and the trained ones
//! - `evaluate_model`: evaluate a model without a run; models of other runs
//! - `run`: a run: open, train, evaluate

pub(crate) mod eval_folder;
pub(crate) mod evaluate_model;
pub(crate) mod init_from;
pub(crate) mod lock;
pub(crate) mod logs;
pub(crate) mod run;
pub(crate) mod run_file;
pub(crate) mod train_loop;
pub(crate) mod validation;
