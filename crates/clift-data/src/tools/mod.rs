//! The operations of `clift data`: info, check, convert, index, synth.
//!
//! - `info`: counts and sizes of a source
//! - `index_statistics`: statistics of an evaluation index
//! - `overlap_index`: make an evaluation index
//! - `export`: write a source as chunks
//! - `convert`: convert any layout
//! - `features`: corners, matches and epipolar geometry
//! - `check`: images, cameras, and poses against the images

pub(crate) mod check;
pub(crate) mod convert;
pub(crate) mod export;
pub(crate) mod features;
pub(crate) mod index_statistics;
pub(crate) mod info;
pub(crate) mod overlap_index;
