//! Devices by name, and their limits.
//!
//! - `adapter`: GPU adapters and their limits
//! - `name`: device names, and opening a device

pub(crate) mod adapter;
pub(crate) mod name;
