//! Scenes that the viewer offers.
//!
//! - `scene_set`: a scene file, or the test scenes of a run
//! - `open_scene`: a scene ready to render, with all that the page shows of it

pub(crate) mod open_scene;
pub(crate) mod scene_set;
