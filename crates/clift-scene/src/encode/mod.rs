//! Encoding of captured images, up to the scene file.
//!
//! - `names`: scenes by key, frames by position or file name
//! - `options`: the settings
//! - `contexts`: the context views, by default groups of neighbours (`groups`)
//! - `photo_size`: the size at which a network sees whole photos
//! - `encode`: tokens, clusters, condenser
//! - `cluster_map`: the clusters for a JSON file
//! - `coding`: how the file stores the tokens
//! - `encode_scene`: all of it in one call, with a report

pub(crate) mod cluster_map;
pub(crate) mod coding;
pub(crate) mod contexts;
pub(crate) mod encode;
pub(crate) mod encode_scene;
pub(crate) mod groups;
pub(crate) mod names;
pub(crate) mod options;
pub(crate) mod photo_size;
