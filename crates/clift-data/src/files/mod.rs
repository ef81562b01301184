//! Reading files safely.
//!
//! - `bounded`: reading with a size limit, JSON
//! - `hash`: SHA-256 of a file
//! - `listing`: file names of a folder, natural order

pub(crate) mod bounded;
pub(crate) mod hash;
pub(crate) mod listing;
