//! GPU kernels of clift, in `CubeCL`: buffers in, buffers out.
//!
//! A cube is a workgroup, a unit a thread, a plane a subgroup. No kernel uses atomics and none is chosen by timing at run time:
//! a computation gives the same bytes at every run on an adapter.
//!
//! - `adapter`: matrix instructions of an adapter
//! - `buffers`: buffers and their vectors, elementwise kernels, sums of rows and columns, AdamW
//! - `rows`: layer norm, RMS norm, GELU
//! - `products`: products in f32 registers or cooperative matrices, and the table of their tiles
//! - `attention`: attention, attention inside clusters, transforms of heads by cameras
//! - `ledger`: the kernels that a computation launches
//!
//! `examples/sweep` times candidate tiles.
#![cfg(feature = "wgpu")]
#![expect(
    clippy::collapsible_if,
    clippy::manual_is_multiple_of,
    clippy::needless_range_loop,
    clippy::too_many_lines,
    clippy::trivially_copy_pass_by_ref,
    clippy::used_underscore_binding,
    reason = "kernels are written in the part of Rust that CubeCL translates"
)]

mod adapter;
mod attention;
mod buffers;
mod ledger;
mod products;
mod rows;
#[cfg(test)]
mod testing;

pub use adapter::{AdapterClass, MatrixShape};
pub use attention::attention::{AttentionGradients, AttentionSizes, HeadRows, attention_backward, attention_forward};
pub use attention::cluster_attention::{ClusterSizes, cluster_attention_backward, cluster_attention_forward};
pub use attention::head_transform::{PartTransform, transform_heads};
pub use attention::matrix_scores::AttentionTile;
pub use attention::tiles::attention_tiles;
pub use buffers::adamw::{AdamW, adamw, gradient_norm};
pub use buffers::buffer::{Buffer, Matrices, Values};
pub use buffers::elementwise::cast;
pub use buffers::reduce::sum_rows;
pub use ledger::{Launch, observe, reserved_bytes};
pub use products::convolution::{KERNEL_LEN, convolve};
pub use products::matrix_product::MatrixTile;
pub use products::product::Product;
pub use products::register_product::RegisterTile;
pub use products::tiles::ProductTile;
pub use rows::gelu::{gelu_backward, gelu_forward};
pub use rows::layer_norm::{layer_norm_backward, layer_norm_forward};
pub use rows::rms_norm::{NormHeads, rms_norm_backward, rms_norm_forward};
