//! `clift bench`: time the method, f16 beside f32, and reading clips.
//!
//! - `timing_args`: options of `clift bench` and `clift bench precision`
//! - `data`: `clift bench data`
//! - `precision`: `clift bench precision`
//! - `cases`: `clift bench`

pub(crate) mod cases;
pub(crate) mod data;
pub(crate) mod precision;
pub(crate) mod timing_args;
