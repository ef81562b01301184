//! The TOML file: keys, checks, messages.
//!
//! - `schema`: known keys, derived from the types
//! - `diagnostic`: line and caret (codespan-reporting)
//! - `overrides`: `--set key=TOML`
//! - `errors`: unknown keys, wrong values, ranges
//! - `config`: every key of an experiment
//! - `checks`: values that must fit each other
//! - `parse`: read a config file

pub(crate) mod checks;
pub(crate) mod config;
pub(crate) mod diagnostic;
pub(crate) mod errors;
pub(crate) mod overrides;
pub(crate) mod parse;
pub(crate) mod schema;
