//! `clift doctor`: `run` checks the devices, with the table of `adapters`; `stability` runs the hard numerical cases.

pub(crate) mod adapters;
pub(crate) mod run;
pub(crate) mod stability;
