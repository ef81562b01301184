//! Memory that a run needs, checked before it starts.
//!
//! [`largest_tensor`] refuses tensors that the device cannot hold; [`memory`] estimates the peak of every part of a run
//! and warns where the device has less. Both count from the [`scene_sizes`] that a config can give.

pub mod largest_tensor;
pub mod machine;
pub mod memory;
pub mod scene_sizes;
