//! The default implementations of [`Kernels`](crate::ops::kernels::Kernels): compositions of Burn's operations, on any backend.
//! Matrix products whose operands are rounded are an argument.
//!
//! - `primitives`: slices, sums and means that several of them use
//! - `layers`: linear layer, GELU, norms and convolutions
//! - `attention`: softmax attention in chunks of queries
//! - `cluster_attention`: attention inside clusters
//! - `head_transform`: transforms of heads by the cameras of tokens

pub(crate) mod attention;
pub(crate) mod cluster_attention;
pub(crate) mod head_transform;
pub(crate) mod layers;
pub(crate) mod primitives;
