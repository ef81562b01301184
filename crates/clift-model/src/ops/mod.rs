//! Operations with a hand-written backward, on every backend.
//!
//! An operation has a function on tensors and says what it saves for its backward. It computes by the methods of
//! [`Kernels`](kernels::Kernels), which every backend implements: by native kernels, or, where it has none, by compositions of
//! Burn's operations.
//!
//! - `linear`: linear layer, alone or after a layer norm or GELU
//! - `rms_norm`: RMS norms of the heads of queries and keys
//! - `attention`, `cluster_attention`: softmax attention, and that inside clusters
//! - `head_transform`: heads in the frame of a token's camera, for camera-relative attention
//! - `convolution`: convolutions with constant weights, of the perceptual loss and LPIPS
//! - `matmul`, `optimizer`: products and updates of parameters, without a backward
//! - `kernels`: the trait; `composed`: its default implementations; `backends`: those of each backend
//! - `autodiff`: an operation as a node of the autodiff graph
//! - `precision`: f32, bf16 or f16 operands of matrix products, per scope
//! - `mac_counter`: multiply-accumulates, counted in tests
//!
//! CPU kernels on slices are in the crate `clift-kernels`, GPU kernels on buffers of `CubeCL` in the crate `clift-cube`.

pub(crate) mod attention;
pub(crate) mod autodiff;
pub(crate) mod backends;
pub(crate) mod cluster_attention;
pub(crate) mod composed;
pub(crate) mod convolution;
pub(crate) mod head_transform;
pub(crate) mod kernels;
pub(crate) mod linear;
pub(crate) mod mac_counter;
pub(crate) mod matmul;
pub(crate) mod optimizer;
pub(crate) mod precision;
pub(crate) mod rms_norm;
