//! The implementations of [`Kernels`](crate::ops::kernels::Kernels), and the list of backends.
//!
//! - `dispatch`: the list: an operation runs on the backend of its tensors
//! - `flex`: Burn's CPU backend, by the kernels of `clift-kernels` in f32 and bf16
//! - `cube`: GPUs, by the kernels of `clift-cube`
//! - `cube_buffers`: its tensors as buffers
//!
//! `NdArray` computes by the default implementations; `dispatch` has the line.

#[cfg(feature = "wgpu")]
pub(crate) mod cube;
#[cfg(feature = "wgpu")]
pub(crate) mod cube_buffers;
pub(crate) mod dispatch;
pub(crate) mod flex;
