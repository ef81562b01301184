//! Scenes in `.torch` files: the chunks of pixelSplat, and one file per scene.
//!
//! - `chunk_source`: scenes of pixelSplat chunks
//! - `census`: cached numbers of frames and fields of view
//! - `index`: the file of every scene
//! - `table`: byte ranges of the scenes of a chunk
//! - `writer`: writing scenes as chunks

pub(crate) mod census;
pub(crate) mod chunk_source;
pub(crate) mod index;
pub(crate) mod table;
pub(crate) mod writer;
