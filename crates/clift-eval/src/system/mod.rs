//! The machine and the memory of the process.
//!
//! - `machine`: processor and memory, for reports
//! - `memory`: kept, peak and free memory

pub(crate) mod machine;
pub(crate) mod memory;
