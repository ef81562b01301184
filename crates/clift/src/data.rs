//! `clift data`: make scenes, or tell what there is.

pub mod args;
pub mod info;
mod report;
pub mod synth;
pub mod text;
