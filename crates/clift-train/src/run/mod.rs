//! A run directory from open to report.
//!
//! - `lock`: one process per run directory
//! - `logs`: metrics, bad steps, skips as JSONL
//! - `extend`: `--extend`
//! - `run_file`: run.json; same settings on resume
//! - `stage_plan`: trained modules, start of a stage
//! - `validation`: held-out views during training
//! - `train_loop`: step, save, validate
//! - `train_stage`: resume or start a stage
//! - `init_from`: start from other weights
//! - `run`: a run: open, train, evaluate

pub(crate) mod evaluate_model;
pub(crate) mod extend;
pub(crate) mod init_from;
pub(crate) mod lock;
pub(crate) mod logs;
pub(crate) mod run;
pub(crate) mod run_file;
pub(crate) mod stage_plan;
pub(crate) mod train_loop;
pub(crate) mod train_stage;
pub(crate) mod validation;
