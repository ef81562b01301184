//! Devices by name, and their limits.
//!
//! - `adapter`: GPU adapters and their limits
//! - `ledger`: the kernels that a computation launches on a GPU
//! - `name`: device names, and opening a device

pub(crate) mod adapter;
pub(crate) mod ledger;
pub(crate) mod name;
