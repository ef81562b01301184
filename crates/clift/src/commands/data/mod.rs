//! `clift data`: create, pose, inspect, check and index data sets.
//!
//! One file per subcommand; `command` lists them. `poses` drives COLMAP's steps
//! (`colmap`) and ffmpeg by `tool`.

pub(crate) mod check;
pub(crate) mod colmap;
pub(crate) mod command;
pub(crate) mod index;
pub(crate) mod info;
pub(crate) mod poses;
pub(crate) mod synth;
pub(crate) mod tool;
