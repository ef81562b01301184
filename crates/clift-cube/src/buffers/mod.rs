//! Buffers, their loads in vectors of four, elementwise kernels, and sums of rows and columns.

pub(crate) mod buffer;
pub(crate) mod elementwise;
pub(crate) mod load;
pub(crate) mod reduce;
