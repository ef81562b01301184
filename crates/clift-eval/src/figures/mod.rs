//! Result images.
//!
//! - `canvas`: an 8-bit RGB image with text
//! - `contact_sheet`: rows of views, columns of methods
//! - `animation`: animated PNG, streamed

pub(crate) mod animation;
pub(crate) mod canvas;
pub(crate) mod contact_sheet;
