//! `clift render`: frames of a scene file along a camera path.
//!
//! - `args`: arguments of `clift render`
//! - `frames`: render and write every frame
//! - `run`: `clift render`

pub(crate) mod args;
pub(crate) mod frames;
pub(crate) mod run;
