//! Operations with a hand-written backward: native kernels on `flex`, composed of Burn's operations on other backends.
//!
//! Shared parts:
//! - `autodiff`: gradients of an operation for its inputs
//! - `flex`: tensors of Burn's CPU backend as f32 slices
//! - `mac_counter`: multiply-accumulates, counted in tests
//! - `precision`: f32, bf16 or f16 operands of matrix products, per scope
//! - `saved`: tensors that are saved for the backward, in bf16 where the precision is bf16
//!
//! Operations:
//! - `gelu`: GELU with exact gradient
//! - `layer_norm`: layer normalization
//! - `rms_norm`: RMS norms of the heads of queries and keys
//! - `linear`: linear layer, alone or fused with a layer norm or GELU
//! - `attention`: softmax attention
//! - `cluster_attention`: attention inside clusters, linear in the number of tokens
//! - `head_transform`: heads in the frame of a token's camera, for camera-relative attention

pub(crate) mod attention;
pub(crate) mod autodiff;
pub(crate) mod cluster_attention;
pub(crate) mod flex;
pub(crate) mod gelu;
pub(crate) mod head_transform;
pub(crate) mod layer_norm;
pub(crate) mod linear;
pub(crate) mod mac_counter;
pub(crate) mod precision;
pub(crate) mod rms_norm;
pub(crate) mod saved;
