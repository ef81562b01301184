//! Softmax attention as one operation, with memory linear in the number of tokens.
//!
//! - `composed`: attention in chunks of queries, on any backend
//! - `backends`: the implementation of every backend, native or composed
//! - `sdpa`: the operation and its backward

pub(crate) mod backends;
pub(crate) mod composed;
pub(crate) mod sdpa;
