//! Atomic writes.
//!
//! - `atomic`: atomic writes of a file or a folder
//! - `staged_dir`: several files that appear together

pub(crate) mod atomic;
pub(crate) mod staged_dir;
