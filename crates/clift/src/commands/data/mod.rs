//! `clift data`: create, pose, inspect, check, convert and index data sets.
//!
//! One file per subcommand; `command` lists them, `info_report` formats the result of `info`. `poses` drives COLMAP's
//! steps (`colmap`) and ffmpeg by `tool`.

pub(crate) mod check;
pub(crate) mod colmap;
pub(crate) mod command;
pub(crate) mod convert;
pub(crate) mod index;
pub(crate) mod info;
pub(crate) mod info_report;
pub(crate) mod poses;
pub(crate) mod synth;
pub(crate) mod tool;
