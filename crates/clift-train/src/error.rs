//! Errors of training runs.

use std::path::{Path, PathBuf};

use clift_core::BadConfig;

/// An error of this crate. Messages have the problem, the value found, the remedy, and the path last.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TrainError {
    /// A file could not be opened, read or written.
    #[error("{action} failed: {source}: {path}", path = path.display())]
    Io {
        /// The action, as a verb phrase.
        action: &'static str,
        /// Error of the operating system.
        source: std::io::Error,
        /// The file.
        path: PathBuf,
    },
    /// A value of the configuration is invalid.
    #[error(transparent)]
    BadConfig(#[from] BadConfig),
    /// The run directory contains a run with other settings.
    #[error(
        "this run was started with other settings:\n{differences}\nresume with the old values, {or}set another `run_dir`, or \
         start a new run with --fresh: {path}",
        path = path.display()
    )]
    OtherRun {
        /// One line per differing key: `key: old -> new`.
        differences: String,
        /// Another remedy, or empty.
        or: &'static str,
        /// The run directory.
        path: PathBuf,
    },
    /// The content of a file is invalid.
    #[error("bad {what}: {reason}: {path}", path = path.display())]
    BadFile {
        /// Kind of the file.
        what: &'static str,
        /// The problem.
        reason: String,
        /// The file.
        path: PathBuf,
    },
    /// The cluster cache was built with another encoder or other settings.
    #[error("stale cluster cache: {reason}; remove the cache to build a new one: {path}", path = path.display())]
    StaleClusters {
        /// The difference.
        reason: String,
        /// Folder of the cache.
        path: PathBuf,
    },
    /// Stage 2 was trained on another encoder than stage 1.
    #[error(
        "stage 2 was trained on another encoder than stage 1; remove stage2/ and clusters/ and train stage 2 again: \
         {path}",
        path = path.display()
    )]
    OtherEncoder {
        /// The weights of stage 2.
        path: PathBuf,
    },
    /// A stage needs the result of a stage that has not run.
    #[error("{stage} needs {what}, not found at {path}; run `{first}` first", path = path.display())]
    Missing {
        /// The requested stage.
        stage: &'static str,
        /// The missing result.
        what: &'static str,
        /// Arguments that make the result.
        first: &'static str,
        /// Expected path.
        path: PathBuf,
    },
    /// A tensor could not be read back from its device.
    #[error("reading a tensor from its device failed: {reason}")]
    Tensor {
        /// Error of the device.
        reason: String,
    },
    /// Too many consecutive steps were skipped.
    #[error(
        "skipped {count} consecutive steps, the last at step {step}: {reason} (scenes {keys}); all are listed in \
         bad_steps.jsonl; the last good checkpoint is {checkpoint}"
    )]
    Diverged {
        /// Number of skipped steps.
        count: u32,
        /// The last skipped step.
        step: u64,
        /// Anomaly of the last step.
        reason: String,
        /// Scenes of the last batch.
        keys: String,
        /// The newest checkpoint, or "none".
        checkpoint: String,
    },
    /// A stage failed after it had saved its steps.
    #[error("{source}\n{stage} stopped after step {step}; the last good checkpoint is {checkpoint}")]
    Stopped {
        /// The error.
        source: Box<TrainError>,
        /// The stage.
        stage: &'static str,
        /// The last step.
        step: u64,
        /// The newest checkpoint, or "none".
        checkpoint: String,
    },
    /// A checkpoint cannot be read.
    #[error("{source}\nthe newest checkpoint is damaged: {fix}")]
    Damaged {
        /// The problem.
        source: Box<TrainError>,
        /// The remedy.
        fix: String,
    },
    /// Another process uses the run directory or the output folder.
    #[error("{what} {path} is in use by {holder}; wait until it exits or set {elsewhere}", path = path.display())]
    Locked {
        /// Kind of the folder.
        what: &'static str,
        /// The process, if known.
        holder: String,
        /// The setting of another folder.
        elsewhere: &'static str,
        /// The folder.
        path: PathBuf,
    },
    /// The run directory was moved or removed while the run was training.
    #[error("the run directory was moved or removed during training; resume at its new place with --set run_dir: {path}", path = path.display())]
    Moved {
        /// The former path.
        path: PathBuf,
    },
    /// No scene is left to train or evaluate on.
    #[error("no usable scene: {reason}")]
    NoScenes {
        /// Why no scene is left.
        reason: String,
    },
    /// The run was interrupted and has saved its steps.
    #[error("interrupted at step {step}; the same command resumes")]
    Interrupted {
        /// The last step.
        step: u64,
    },
    /// A task without intermediate results was interrupted.
    #[error("interrupted while {task}; no output files were written")]
    Abandoned {
        /// The unfinished task, as a gerund phrase.
        task: String,
    },
    /// Another rank of the run has failed.
    #[error("rank {rank} failed: {reason}")]
    OtherRank {
        /// The rank.
        rank: usize,
        /// Its error.
        reason: String,
    },
    /// Ranks that must agree differ.
    #[error(
        "{what} of rank {rank} differ from rank 0's; all ranks need the same program, config and data, and a run directory on \
         a file system that they share"
    )]
    RanksDiffer {
        /// The difference.
        what: &'static str,
        /// The first rank that differs.
        rank: usize,
    },
    /// A launcher started several processes that cannot be connected.
    #[error("a launcher started {num_ranks} processes, and {reason}")]
    NoMpi {
        /// Number of processes.
        num_ranks: usize,
        /// Why they are not connected, and the remedy.
        reason: String,
    },
    /// A device failed.
    #[error("the device failed: {reason}")]
    Device {
        /// Error of the device.
        reason: String,
    },
    /// Scenes could not be read.
    #[error(transparent)]
    Data(#[from] clift_data::DataError),
    /// Input or weights of the model are invalid.
    #[error(transparent)]
    Model(#[from] clift_model::ModelError),
    /// Coding tokens failed.
    #[error(transparent)]
    Scene(#[from] clift_scene::SceneError),
    /// Evaluation failed.
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
