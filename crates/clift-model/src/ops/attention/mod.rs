//! Softmax attention as one operation.
//!
//! - `composed`: attention in query chunks, any backend
//! - `backends`: native CPU kernels or composed
//! - `sdpa`: attention operation with its own backward

pub(crate) mod backends;
pub(crate) mod composed;
pub(crate) mod sdpa;
