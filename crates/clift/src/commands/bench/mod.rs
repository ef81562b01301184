//! `clift bench`.
//!
//! - `cases`: `clift bench`
//! - `precision`: `clift bench precision`
//! - `data`: `clift bench data`

pub(crate) mod cases;
pub(crate) mod data;
pub(crate) mod precision;
