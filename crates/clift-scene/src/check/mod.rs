//! A check of a scene: a frame that is not a context view, rendered and compared with a copy of the nearest context view.
//!
//! - `baselines`: nearest context view, mean of the context views
//! - `held_out_frame`: the rendered frame

pub(crate) mod baselines;
pub(crate) mod held_out_frame;
