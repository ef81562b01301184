//! A run directory from open to report.
//!
//! - `lock`: lock of a run directory or an output folder
//! - `eval_folder`: output folder of an evaluation
//! - `first_steps`: pace of a stage; whether reading limits the speed
//! - `logs`: metrics, skipped steps and scenes as JSONL
//! - `extend`: `--extend`
//! - `run_file`: run.json; same settings on resume
//! - `training_data`: the data that a run was trained on
//! - `training_curves`: curves of metrics.jsonl and validation.jsonl
//! - `stage_plan`: settings, batches and folder of a stage
//! - `validation`: validation and evaluation
//! - `train_loop`: resume or start a stage; step, save, validate
//! - `init_from`: initial weights of a stage, and weights between those and the trained ones
//! - `evaluate_model`: evaluate a model without a run; models of other runs
//! - `run`: a run: open, train, evaluate

pub(crate) mod eval_folder;
pub(crate) mod evaluate_model;
pub(crate) mod extend;
pub(crate) mod first_steps;
pub(crate) mod init_from;
pub(crate) mod lock;
pub(crate) mod logs;
pub(crate) mod run;
pub(crate) mod run_file;
pub(crate) mod stage_plan;
pub(crate) mod train_loop;
pub(crate) mod training_curves;
pub(crate) mod training_data;
pub(crate) mod validation;
