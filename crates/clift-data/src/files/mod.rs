//! Reading files safely.
//!
//! - `bounded`: reading with a size limit, JSON
//! - `caches`: the folder for caches
//! - `hash`: SHA-256 of a file
//! - `listing`: file names of a folder, natural order

pub(crate) mod bounded;
pub(crate) mod caches;
pub(crate) mod hash;
pub(crate) mod listing;
