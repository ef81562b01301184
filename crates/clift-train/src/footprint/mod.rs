//! Parameters and memory of a run, counted before it starts.
//!
//! - `estimate`: speed of a run, and its remaining time
//! - `largest_tensor`: refuse tensors a device cannot hold
//! - `memory`: memory of each part, warning
//! - `plan`: counts of all parts, for `clift plan`

pub(crate) mod estimate;
pub(crate) mod largest_tensor;
pub(crate) mod memory;
pub(crate) mod plan;
