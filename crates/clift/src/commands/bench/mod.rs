//! `clift bench`: times of the method (`cases`), of f16 or bf16 beside f32 (`precision`), and of reading clips
//! (`data`).
//!
//! `timing_args` has the options that `cases` and `precision` share.

pub(crate) mod cases;
pub(crate) mod data;
pub(crate) mod precision;
pub(crate) mod timing_args;
