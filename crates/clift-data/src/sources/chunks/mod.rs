//! Scenes in `.torch` files: the chunks of pixelSplat, and one file per scene.
//!
//! - `chunk_source`: scenes of pixelSplat chunks
//! - `index`: the file of every scene
//! - `index_cache`: cached numbers of frames and fields of view
//! - `table`: byte ranges of the scenes of a chunk
//! - `writer`: writing scenes as chunks

pub(crate) mod chunk_source;
pub(crate) mod index;
pub(crate) mod index_cache;
pub(crate) mod table;
pub(crate) mod writer;
