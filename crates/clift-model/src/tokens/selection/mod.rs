//! Selection of the tokens for a target view (paper section 3.3, Algorithm 1).
//!
//! - `token_ray`: the ray of a stored token
//! - `rules`: weights and grid of the selection, by preset
//! - `selector`: the algorithm, frame by frame

pub(crate) mod rules;
pub(crate) mod selector;
pub(crate) mod token_ray;
