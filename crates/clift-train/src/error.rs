//! What can go wrong in a run, one documented variant per failure.

use std::path::{Path, PathBuf};

/// A failure of this crate. A message says what, where, expected and got, with the path last.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TrainError {
    /// A file could not be opened, read or written.
    #[error("{action} failed: {source}: {path}", path = path.display())]
    Io {
        /// What was being done, as a verb phrase.
        action: &'static str,
        /// The operating system's reason.
        source: std::io::Error,
        /// The file.
        path: PathBuf,
    },
    /// A configuration value is out of its range.
    #[error("`{key}` = {value}: {fix}")]
    BadConfig {
        /// Dotted key, as in the TOML file.
        key: String,
        /// The value found.
        value: String,
        /// What to write instead.
        fix: String,
    },
    /// The run directory holds a run with other settings.
    #[error(
        "this run was started with other settings:\n{differences}\nresume with the old values, {or}choose another \
         `run_dir`, or start over with --fresh: {path}",
        path = path.display()
    )]
    OtherRun {
        /// One line per differing key: `key: old -> new`.
        differences: String,
        /// Another way on, where there is one.
        or: &'static str,
        /// The run directory.
        path: PathBuf,
    },
    /// A file of a run does not hold what it should.
    #[error("bad {what}: {reason}: {path}", path = path.display())]
    BadFile {
        /// Which kind of file.
        what: &'static str,
        /// What is wrong with it.
        reason: String,
        /// The file.
        path: PathBuf,
    },
    /// The cluster cache belongs to another encoder or other settings.
    #[error("stale cluster cache: {reason}; move it away to make a new one: {path}", path = path.display())]
    StaleClusters {
        /// What differs.
        reason: String,
        /// The cache.
        path: PathBuf,
    },
    /// The weights of the two stages belong to different trainings.
    #[error(
        "the weights of stage 2 were trained on another encoder than stage 1 has now; move stage2/ and clusters/ away \
         and train stage 2 again: {path}",
        path = path.display()
    )]
    OtherEncoder {
        /// The weights of stage 2.
        path: PathBuf,
    },
    /// A stage needs the result of one that has not run.
    #[error("{stage} needs {what}, which is not there; run {first} first: {path}", path = path.display())]
    Missing {
        /// The stage that was asked for.
        stage: &'static str,
        /// What it needs.
        what: &'static str,
        /// The stage that makes it.
        first: &'static str,
        /// Where it was looked for.
        path: PathBuf,
    },
    /// A tensor could not be read back from its device.
    #[error("reading tokens from their device failed: {reason}")]
    Tensor {
        /// The device's reason.
        reason: String,
    },
    /// Several steps in a row had to be left out.
    #[error(
        "{count} steps in a row were left out, up to step {step}: {reason} (scenes {keys}); bad_steps.jsonl has them \
         all; the last good checkpoint is {checkpoint}"
    )]
    Diverged {
        /// How many.
        count: u32,
        /// The last of them.
        step: u64,
        /// What was wrong with that.
        reason: String,
        /// Scenes of its batch.
        keys: String,
        /// The newest checkpoint, or "none".
        checkpoint: String,
    },
    /// A stage could not go on. What it had done is on the disk.
    #[error("{source}\n{stage} stopped after step {step}; the last good checkpoint is {checkpoint}")]
    Stopped {
        /// What went wrong.
        source: Box<TrainError>,
        /// The stage.
        stage: &'static str,
        /// Its last step.
        step: u64,
        /// The newest checkpoint, or "none".
        checkpoint: String,
    },
    /// A checkpoint cannot be read.
    #[error("{source}\nthe newest checkpoint is damaged: {fix}")]
    Damaged {
        /// What is wrong with it.
        source: Box<TrainError>,
        /// What to do about it.
        fix: String,
    },
    /// Another process works in the run directory.
    #[error("{holder} is working in this run directory; wait for its end or choose another `run_dir`: {path}", path = path.display())]
    Locked {
        /// Which process, where that is known.
        holder: String,
        /// The run directory.
        path: PathBuf,
    },
    /// No scene is left to train or evaluate on.
    #[error("no usable scene: {reason}")]
    NoScenes {
        /// Why none is left.
        reason: String,
    },
    /// The run was asked to stop, and has saved.
    #[error("interrupted at step {step}; the same command resumes")]
    Interrupted {
        /// Steps done.
        step: u64,
    },
    /// Work that keeps nothing of what is not done was asked to stop.
    #[error("interrupted during {work}; nothing was written")]
    Abandoned {
        /// What was not finished.
        work: String,
    },
    /// A device gave up on work it had accepted.
    #[error("the device failed: {reason}")]
    Device {
        /// Its own words.
        reason: String,
    },
    /// Scenes could not be read.
    #[error(transparent)]
    Data(#[from] clift_data::DataError),
    /// The model refused its input or its weights.
    #[error(transparent)]
    Model(#[from] clift_model::ModelError),
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
    /// Wraps an operating-system error; for `map_err`.
    pub fn io(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> Self {
        move |source| Self::Io { action, source, path: path.to_path_buf() }
    }

    /// A [`TrainError::BadFile`]; for `map_err`.
    pub fn bad_file<E: std::fmt::Display>(what: &'static str, path: &Path) -> impl FnOnce(E) -> Self {
        move |reason| Self::BadFile { what, reason: reason.to_string(), path: path.to_path_buf() }
    }
}

/// A [`TrainError::BadConfig`].
pub(crate) fn bad(key: &str, value: impl std::fmt::Display, fix: &str) -> TrainError {
    TrainError::BadConfig { key: key.into(), value: value.to_string(), fix: fix.into() }
}
