//! What can go wrong between a file and a clip, one documented variant per failure.

use std::path::PathBuf;

/// A failure of this crate. A message says what, where, expected and got, with the path last.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DataError {
    /// A file could not be opened, read or written.
    #[error("{action} failed: {source}: {path}", path = path.display())]
    Io {
        /// What was being done, as a verb phrase ("reading the chunk").
        action: &'static str,
        /// The operating system's reason.
        source: std::io::Error,
        /// The file.
        path: PathBuf,
    },
    /// A camera holds a NaN or an infinity, or its rotation is not one.
    #[error("bad camera: {what}")]
    BadCamera {
        /// What is wrong with it, with the number that shows it.
        what: String,
    },
    /// A configuration value cannot be used.
    #[error("{key} {problem}")]
    BadConfig {
        /// Dotted key of the value, relative to its table.
        key: String,
        /// The value, what is wrong with it and what would be right, as a verb phrase.
        problem: String,
    },
    /// A scene is too short for the views that are to be drawn from it.
    #[error("not enough frames: {needed} needed, {got} in the scene")]
    NotEnoughFrames {
        /// Fewest frames that would do.
        needed: usize,
        /// Frames the scene has.
        got: usize,
    },
    /// No scene, or no frame of a scene, is at the position asked for.
    #[error("no {what} {index}: there are {count}")]
    OutOfRange {
        /// What was asked for ("scene", "frame").
        what: &'static str,
        /// Position asked for.
        index: usize,
        /// How many there are.
        count: usize,
    },
    /// A batch slot found no usable scene within its tries.
    #[error(
        "no usable scene for slot {slot} of step {step} in {attempts} tries; the last, {key}, failed with: {reason}"
    )]
    NoUsableScene {
        /// Step of the batch.
        step: u64,
        /// Slot of the batch.
        slot: usize,
        /// How many scenes were tried.
        attempts: u32,
        /// Key of the last scene tried.
        key: String,
        /// Why the last one failed.
        reason: String,
    },
    /// The code that makes a batch panicked.
    #[error(transparent)]
    WorkerPanic(#[from] crate::loader::WorkerPanic),
}

impl DataError {
    /// A [`DataError::BadConfig`] about `key`.
    pub(crate) fn bad_config(key: impl Into<String>, problem: impl Into<String>) -> Self {
        Self::BadConfig { key: key.into(), problem: problem.into() }
    }
}
