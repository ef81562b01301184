//! Memory requirements, checked before a run.
//!
//! - `scene_sizes`: possible sizes of a step
//! - `memory`: memory of each part, warning
//! - `largest_tensor`: refuse tensors a device cannot hold

pub(crate) mod largest_tensor;
pub(crate) mod memory;
pub(crate) mod scene_sizes;
