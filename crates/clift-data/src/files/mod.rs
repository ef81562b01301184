//! Reading and writing files safely.
//!
//! - `atomic`: atomic writes of a file or a folder
//! - `staged_dir`: several files that appear together
//! - `bounded`: reading with a size limit, JSON
//! - `caches`: the folder for caches
//! - `listing`: file names of a folder, natural order

pub(crate) mod atomic;
pub(crate) mod bounded;
pub(crate) mod caches;
pub(crate) mod listing;
pub(crate) mod staged_dir;
