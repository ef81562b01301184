//! `clift data`.
//!
//! - `synth`: `clift data synth`
//! - `info`: `clift data info`
//! - `info_report`: its table and JSON
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
pub(crate) mod text;
