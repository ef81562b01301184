//! Data sets through the command line: other layouts than chunks, conversion, checks and timing.

mod convert;
mod data_tools;
mod layouts;
pub(crate) mod poses;
