//! The default implementations of [`Kernels`](crate::ops::kernels::Kernels): compositions of Burn's operations, on any backend.
//! Matrix products whose operands are rounded are an argument.
//!
//! - `primitives`: slices, sums and means that several of them use
//! - `linear`: linear layer
//! - `gelu`: GELU and its exact gradient
//! - `norms`: layer norm, and RMS norms of heads
//! - `attention`: softmax attention in chunks of queries
//! - `cluster_attention`: attention inside clusters
//! - `head_transform`: transforms of heads by the cameras of tokens
//! - `convolution`: convolutions by Burn

pub(crate) mod attention;
pub(crate) mod cluster_attention;
pub(crate) mod convolution;
pub(crate) mod gelu;
pub(crate) mod head_transform;
pub(crate) mod linear;
pub(crate) mod norms;
pub(crate) mod primitives;
