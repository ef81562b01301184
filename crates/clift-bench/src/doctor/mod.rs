//! Device and numerics checks.
//!
//! - `probe`: small model on every device
//! - `stability`: hard cases against f64

pub(crate) mod probe;
pub(crate) mod stability;
