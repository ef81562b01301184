//! Encoding of captured images, up to the scene file.
//!
//! - `names`: scenes by key, frames by position or file name
//! - `contexts`: the settings, and the context views, by default groups of neighbours
//! - `photo_size`: the size at which a network sees whole photos
//! - `encode`: tokens, clusters, condenser
//! - `refine`: fits the tokens to the photos
//! - `encode_scene`: all of it in one call, with a report

pub(crate) mod contexts;
pub(crate) mod encode;
pub(crate) mod encode_scene;
pub(crate) mod names;
pub(crate) mod photo_size;
pub(crate) mod refine;
