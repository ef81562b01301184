//! Buffers, their loads in vectors of four, elementwise kernels, sums of rows and columns, and AdamW.

pub(crate) mod adamw;
pub(crate) mod buffer;
pub(crate) mod elementwise;
pub(crate) mod load;
pub(crate) mod reduce;
