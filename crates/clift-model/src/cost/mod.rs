//! Cost of a network, derived from `network/layers`.
//!
//! - `scene_sizes`: counts of tokens, views, patches
//! - `parameters`: parameters per network
//! - `macs`: multiply-accumulates and conventions
//! - `memory`: saved activations and peak bytes
//! - `largest_tensor`: largest tensor of each network

pub(crate) mod largest_tensor;
pub(crate) mod macs;
pub(crate) mod memory;
pub(crate) mod parameters;
pub(crate) mod scene_sizes;
