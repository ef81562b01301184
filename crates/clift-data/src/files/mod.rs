//! Reading files safely.
//!
//! - `bounded`: reading with a size limit, JSON
//! - `caches`: the folder for caches
//! - `listing`: file names of a folder, natural order

pub(crate) mod bounded;
pub(crate) mod caches;
pub(crate) mod listing;
