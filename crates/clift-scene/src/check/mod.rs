//! Checks of a scene: renderings beside photos.
//!
//! - `baselines`: nearest context view, mean of the context views
//! - `view_check`: held-out frames and context views, rendered

pub(crate) mod baselines;
pub(crate) mod view_check;
