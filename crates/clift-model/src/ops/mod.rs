//! Operations with a hand-written backward.
//!
//! - `autodiff`: register gradients of own operations
//! - `flex`: Burn CPU tensors as f32 slices
//! - `mac_counter`: count multiply-accumulates in tests
//! - `precision`: f32 or f16 operands, per scope
//! - `gelu`: GELU with exact gradient, per backend
//! - `layer_norm`: layer norm on every backend
//! - `linear`: linear layer, fused with norm or GELU
//! - `attention`: softmax attention as one operation
//! - `cluster_attention`: attention inside clusters, linear in N

pub(crate) mod attention;
pub(crate) mod autodiff;
pub(crate) mod cluster_attention;
pub(crate) mod flex;
pub(crate) mod gelu;
pub(crate) mod layer_norm;
pub(crate) mod linear;
pub(crate) mod mac_counter;
pub(crate) mod precision;
