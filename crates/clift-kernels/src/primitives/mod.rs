//! Building blocks of the kernels.
//!
//! - `matmul`: matrix products that stay in the cache
//! - `packing`: operands of matrix products, laid out for the register tile
//! - `partition`: rows divided among tasks
//! - `scratch`: reusable buffers, one per thread
//! - `shared_slice`: disjoint parallel writes to one slice

pub(crate) mod matmul;
pub(crate) mod packing;
pub(crate) mod partition;
pub(crate) mod scratch;
pub(crate) mod shared_slice;
