//! Attention inside clusters (paper, equation 2), linear in the number of tokens.
//!
//! - `operation`: the operation and its backward, on any backend
//! - `native`: the CPU kernel on flex

pub(crate) mod native;
pub(crate) mod operation;
