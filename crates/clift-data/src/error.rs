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
}
