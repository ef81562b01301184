//! Reading and writing files safely.
//!
//! - `atomic`: atomic writes of files and folders
//! - `staged_dir`: atomic write of several files
//! - `bounded`: read with a size limit
//! - `listing`: file names of a folder, natural order

pub(crate) mod atomic;
pub(crate) mod bounded;
pub(crate) mod listing;
pub(crate) mod staged_dir;
