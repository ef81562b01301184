//! PixelSplat chunks.
//!
//! - `chunk_source`: scenes of pixelSplat chunks
//! - `index`: scene to chunk index
//! - `table`: offset table of a chunk
//! - `writer`: write scenes as chunks

pub(crate) mod chunk_source;
pub(crate) mod index;
pub(crate) mod table;
pub(crate) mod writer;
