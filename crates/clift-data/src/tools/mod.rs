//! The operations of `clift data`: info, check, index, synth.
//!
//! - `info`: counts and sizes of a source
//! - `overlap_index`: make an evaluation index
//! - `export`: scenes and evaluation indices to write
//! - `features`: corners, matches and epipolar geometry
//! - `check`: images, cameras, and poses against the images

pub(crate) mod check;
pub(crate) mod export;
pub(crate) mod features;
pub(crate) mod info;
pub(crate) mod overlap_index;
