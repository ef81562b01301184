//! The machine, for reports.
//!
//! - `machine`: processor and memory, for reports
//! - `memory`: peak and available memory

pub(crate) mod machine;
pub(crate) mod memory;
