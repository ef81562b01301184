//! Attention inside clusters, linear in N.
//!
//! - `operation`: cluster attention with its own backward
//! - `native`: the CPU kernel behind it

pub(crate) mod native;
pub(crate) mod operation;
