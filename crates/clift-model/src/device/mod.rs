//! Devices and their capabilities.
//!
//! - `name`: open a device by name
//! - `adapter`: GPU adapters and their limits

pub(crate) mod adapter;
pub(crate) mod name;
