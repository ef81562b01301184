//! The rows of `clift bench`.
//!
//! - `case`: names of the rows
//! - `reference`: the same computation in f64
//! - `task`: traits of a timed computation
//! - `context`: options, device and sizes of all rows
//! - `flops`: floating-point operations of a row
//! - `forward`: rows without gradient
//! - `step`: rows of whole updates
//! - `clustering`: the K-means row
//! - `coding`: the rows of the token coder
//! - `selection`: the token-selection row

pub(crate) mod case;
pub(crate) mod clustering;
pub(crate) mod coding;
pub(crate) mod context;
pub(crate) mod flops;
pub(crate) mod forward;
pub(crate) mod reference;
pub(crate) mod selection;
pub(crate) mod step;
pub(crate) mod task;
