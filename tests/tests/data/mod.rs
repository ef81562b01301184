//! Data sets through the command line: other layouts than chunks, checks and indices.

mod data_tools;
mod layouts;
pub(crate) mod poses;
