//! Costs of a network, derived from its layers (`network/layers`): `parameters`; multiply-accumulates in `macs`; peak bytes
//! in `memory`; and the `largest_tensor`, which GPUs limit. `scene_sizes` counts the rows of the layers' inputs.

pub(crate) mod largest_tensor;
pub(crate) mod macs;
pub(crate) mod memory;
pub(crate) mod parameters;
pub(crate) mod scene_sizes;
