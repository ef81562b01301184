//! Building blocks of the kernels.
//!
//! - `matmul`: matrix products that stay in cache
//! - `elementwise`: map and combine, vector by vector
//! - `scratch`: per-thread reusable buffers
//! - `shared_slice`: one slice, disjoint parallel writes

pub(crate) mod elementwise;
pub(crate) mod matmul;
pub(crate) mod scratch;
pub(crate) mod shared_slice;
