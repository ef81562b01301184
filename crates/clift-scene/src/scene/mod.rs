//! The scene file, and rendering from it.
//!
//! `scene` holds a stored scene and documents the bytes of its file; `check` the rules of a valid scene; `read` and
//! `write` the file itself, with its `header`; `coded_file` the file with coded tokens, and `coded_views` its cameras;
//! `token_coding` the formats of tokens. `scene_renderer` renders frames of a scene on a device, and `frame_size` makes frames
//! of any size from images of the trained size.

pub(crate) mod check;
pub(crate) mod coded_file;
pub(crate) mod coded_views;
pub(crate) mod frame_size;
pub(crate) mod header;
pub(crate) mod read;
#[allow(clippy::module_inception)] // the file of the type `Scene`
pub(crate) mod scene;
pub(crate) mod scene_renderer;
pub(crate) mod token_coding;
pub(crate) mod write;
