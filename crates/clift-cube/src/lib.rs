//! GPU kernels of clift, in `CubeCL`: buffers in, buffers out.
//!
//! A cube is a workgroup, a unit a thread, a plane a subgroup. No kernel uses atomics and none is chosen by a measurement: a
//! computation gives the same bytes at every run on an adapter.
//! - `buffer`, `load`, `elementwise`, `reduce`: buffers and their vectors, sums of columns and rows
//! - `adapter`: cooperative matrices of an adapter, and the table of tiles
//! - `product`: products, on `register_product` (f32) or `matrix_product` (cooperative matrices, f16), with an `epilogue`
//! - `attention`: attention with its backward, on `register_attention` or `matrix_attention`
//! - `cluster_attention`, `head_transform`, `layer_norm`, `rms_norm`, `gelu`, `adamw`: an operation each
//!
//! `examples/sweep.rs` times the tiles of the table.
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

mod adamw;
mod adapter;
mod attention;
mod buffer;
mod cluster_attention;
mod elementwise;
mod epilogue;
mod gelu;
mod head_rows;
mod head_transform;
mod layer_norm;
mod load;
mod matrix_attention;
mod matrix_product;
mod matrix_scores;
mod product;
mod product_kind;
mod reduce;
mod register_attention;
mod register_product;
mod register_scores;
mod rms_norm;
#[cfg(test)]
mod testing;

pub use adamw::{AdamW, adamw, gradient_norm};
pub use adapter::{AdapterClass, ProductTile};
pub use attention::{
    AttentionInputs, AttentionResults, AttentionSizes, HeadRows, attention_backward, attention_backward_tile,
    attention_forward, attention_forward_tile,
};
pub use buffer::{Buffer, Matrices, Values};
pub use cluster_attention::{ClusterSizes, cluster_attention_backward, cluster_attention_forward};
pub use elementwise::cast;
pub use gelu::{gelu_backward, gelu_forward};
pub use head_transform::{PartTransform, transform_heads};
pub use layer_norm::{layer_norm_backward, layer_norm_forward};
pub use matrix_product::{MatrixShape, MatrixTile};
pub use matrix_scores::AttentionTile;
pub use product::Product;
pub use reduce::sum_rows;
pub use register_product::RegisterTile;
pub use rms_norm::{NormHeads, rms_norm_backward, rms_norm_forward};
