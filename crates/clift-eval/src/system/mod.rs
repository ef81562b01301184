//! The machine, for reports.
//!
//! - `machine`: processor and memory, for reports
//! - `memory`: peak memory of the process

pub(crate) mod machine;
pub(crate) mod memory;
