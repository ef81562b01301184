//! `clift data`: create, inspect, check, convert and index data sets.
//!
//! - `synth`: `clift data synth`
//! - `info_report`: table and JSON of `clift data info`
//! - `info`: `clift data info`
//! - `check`: `clift data check`
//! - `convert`: `clift data convert`
//! - `index`: `clift data index`
//! - `command`: the `clift data` subcommands

pub(crate) mod check;
pub(crate) mod command;
pub(crate) mod convert;
pub(crate) mod index;
pub(crate) mod info;
pub(crate) mod info_report;
pub(crate) mod synth;
