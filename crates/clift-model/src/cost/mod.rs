//! The cost of a network, derived from the list of its layers and the sizes of a scene.
//!
//! [`SceneSizes`] counts the rows that layers process; the other files multiply them out: [`Parameters`], [`Macs`],
//! bytes in memory, and the largest tensors.

mod largest_tensor;
mod macs;
mod memory;
mod parameters;
mod scene_sizes;

pub use largest_tensor::{kmeans_values, largest_tensors};
pub use macs::{Convention, Macs};
pub use memory::{InferenceSizes, Segment, UpdateSizes, inference_bytes, render_bytes, update_bytes};
pub use parameters::Parameters;
pub use scene_sizes::SceneSizes;
