//! Algorithm 1: tokens for a view.
//!
//! - `token_ray`: ray of a stored token
//! - `rules`: published presets and their numbers
//! - `selector`: Algorithm 1: nearest tokens of a view

pub(crate) mod rules;
pub(crate) mod selector;
pub(crate) mod token_ray;
