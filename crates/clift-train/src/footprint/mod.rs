//! Memory and operations of a run, counted before it starts.
//!
//! - `scene_sizes`: possible sizes of a step
//! - `memory`: memory of each part, warning
//! - `largest_tensor`: refuse tensors a device cannot hold
//! - `plan`: counts of all parts, for `clift plan`

pub(crate) mod largest_tensor;
pub(crate) mod memory;
pub(crate) mod plan;
pub(crate) mod scene_sizes;
