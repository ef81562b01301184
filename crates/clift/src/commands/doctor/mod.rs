//! `clift doctor`: check the devices of this machine.
//!
//! - `args`: arguments of `clift doctor`
//! - `adapters`: the adapter table
//! - `stability`: `clift doctor --stability`
//! - `run`: `clift doctor`

pub(crate) mod adapters;
pub(crate) mod args;
pub(crate) mod run;
pub(crate) mod stability;
