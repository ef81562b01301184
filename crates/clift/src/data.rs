//! `clift data`: make scenes, tell what there is, check it, index it, convert it.

pub mod args;
pub mod bench;
pub mod check;
pub mod convert;
pub mod index;
pub mod info;
mod open;
mod report;
pub mod synth;
pub mod text;
