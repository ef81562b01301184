//! The scene file, and rendering from it.
//!
//! - `scene`: a stored scene and its format
//! - `check`: validity rules of a scene
//! - `read`: scene files in, bounded
//! - `write`: scene files out
//! - `token_format`: f32, f16, int8 tokens
//! - `scene_renderer`: interactive rendering on a device
//! - `render_budget`: time per frame against tokens

pub(crate) mod check;
pub(crate) mod read;
pub(crate) mod render_budget;
pub(crate) mod scene;
pub(crate) mod scene_renderer;
pub(crate) mod token_format;
pub(crate) mod write;
