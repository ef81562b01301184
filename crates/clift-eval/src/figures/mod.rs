//! Result images.
//!
//! - `canvas`: an 8-bit RGB image with text
//! - `contact_sheet`: rows of views, columns of methods
//! - `animation`: animated PNG, streamed
//! - `video`: MP4 through `ffmpeg`
//! - `scene_figure`: images of one scene for a report

pub(crate) mod animation;
pub(crate) mod canvas;
pub(crate) mod contact_sheet;
pub(crate) mod scene_figure;
pub(crate) mod video;
