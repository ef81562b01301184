//! The scene file, and rendering from it.
//!
//! `scene` holds a stored scene and documents the bytes of its file; `check` the rules of a valid scene; `read` and
//! `write` the file itself, with its `header` and the tokens in a `token_format`; `coded_file` the file with coded tokens,
//! and `coded_views` its cameras; `token_coding` the names of both ways; `model_place` the path of its model.
//! `scene_renderer` renders frames of a scene on a device, `group_shares` from which groups, `frame_size` makes frames of any size from images of the trained
//! size, and `render_budget` measures how many tokens a time per frame allows.

pub(crate) mod check;
pub(crate) mod coded_file;
pub(crate) mod coded_views;
pub(crate) mod frame_size;
pub(crate) mod group_shares;
pub(crate) mod header;
pub(crate) mod model_place;
pub(crate) mod read;
pub(crate) mod render_budget;
#[allow(clippy::module_inception)] // the file of the type `Scene`
pub(crate) mod scene;
pub(crate) mod scene_renderer;
pub(crate) mod token_coding;
pub(crate) mod token_format;
pub(crate) mod write;
