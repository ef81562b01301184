//! The token codec of a model: fitted on training scenes, and its step chosen for a scene.
//!
//! - `progress`: receiver of progress
//! - `fit`: transform, distributions, and measured rates
//! - `step_choice`: the step of one scene for a loss or a size

pub(crate) mod fit;
pub(crate) mod progress;
pub(crate) mod step_choice;
