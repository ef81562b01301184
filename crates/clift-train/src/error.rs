//! Errors of training runs.

use std::path::{Path, PathBuf};

use clift_core::BadConfig;

/// An error of this crate. Messages have the problem, the value found, the remedy, and the path last.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the message of a variant says what its fields are")]
pub enum TrainError {
    #[error("{action} failed: {source}: {path}", path = path.display())]
    Io { action: &'static str, source: std::io::Error, path: PathBuf },
    #[error(transparent)]
    BadConfig(#[from] BadConfig),
    #[error(
        "this run was started with other settings:\n{differences}\nresume with the old values, set another `run_dir`, or \
         start a new run with --fresh: {path}",
        path = path.display()
    )]
    OtherRun { differences: String, path: PathBuf },
    #[error("bad {what}: {reason}: {path}", path = path.display())]
    BadFile { what: &'static str, reason: String, path: PathBuf },
    #[error("stale cluster cache: {reason}; remove the cache to build a new one: {path}", path = path.display())]
    StaleClusters { reason: String, path: PathBuf },
    #[error(
        "stage 2 was trained on another encoder than stage 1; remove stage2/ and clusters/ and train stage 2 again: \
         {path}",
        path = path.display()
    )]
    OtherEncoder { path: PathBuf },
    #[error("{stage} needs {what}, not found at {path}; run `{first}` first", path = path.display())]
    Missing { stage: &'static str, what: &'static str, first: &'static str, path: PathBuf },
    #[error(
        "skipped {count} consecutive steps, the last at step {step}: {reason} (scenes {keys}); all are listed in \
         bad_steps.jsonl; the last good checkpoint is {checkpoint}"
    )]
    Diverged { count: u32, step: u64, reason: String, keys: String, checkpoint: String },
    #[error("{source}\n{stage} stopped after step {step}; the last good checkpoint is {checkpoint}")]
    Stopped { source: Box<TrainError>, stage: &'static str, step: u64, checkpoint: String },
    #[error("{source}\nthe newest checkpoint is damaged: {fix}")]
    Damaged { source: Box<TrainError>, fix: String },
    #[error("{what} {path} is in use by {holder}; wait until it exits or set {elsewhere}", path = path.display())]
    Locked { what: &'static str, holder: String, elsewhere: &'static str, path: PathBuf },
    #[error("the run directory was moved or removed during training; resume at its new place with --set run_dir: {path}", path = path.display())]
    Moved { path: PathBuf },
    #[error("no usable scene: {reason}")]
    NoScenes { reason: String },
    #[error("interrupted at step {step}; the same command resumes")]
    Interrupted { step: u64 },
    #[error("interrupted while {task}; no output files were written")]
    Abandoned { task: String },
    #[error("rank {rank} failed: {reason}")]
    OtherRank { rank: usize, reason: String },
    #[error(
        "{what} of rank {rank} differ from rank 0's; all ranks need the same program, config and data, and a run directory on \
         a file system that they share"
    )]
    RanksDiffer { what: &'static str, rank: usize },
    #[error("a launcher started {num_ranks} processes, and {reason}")]
    NoMpi { num_ranks: usize, reason: String },
    #[error("the device failed: {reason}")]
    Device { reason: String },
    #[error(transparent)]
    Data(#[from] clift_data::DataError),
    #[error(transparent)]
    Model(#[from] clift_model::ModelError),
    #[error(transparent)]
    Scene(#[from] clift_scene::SceneError),
    #[error(transparent)]
    Eval(#[from] clift_eval::EvalError),
}

impl From<clift_data::WorkerPanic> for TrainError {
    fn from(panic: clift_data::WorkerPanic) -> Self {
        Self::Data(panic.into())
    }
}

impl TrainError {
    /// Wraps an error of the operating system; for `map_err`.
    pub fn io(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> Self {
        move |source| Self::Io { action, source, path: path.to_path_buf() }
    }

    /// Makes a [`TrainError::BadFile`]; for `map_err`.
    pub fn bad_file<E: std::fmt::Display>(what: &'static str, path: &Path) -> impl FnOnce(E) -> Self {
        move |reason| Self::BadFile { what, reason: reason.to_string(), path: path.to_path_buf() }
    }
}

pub(crate) fn bad(key: &str, value: impl std::fmt::Display, fix: &str) -> TrainError {
    BadConfig::new(key, value, fix).into()
}
