//! The rows of `clift bench`.
//!
//! - `case`: names of the rows
//! - `reference`: the same computation in f64
//! - `task`: traits of a timed computation
//! - `context`: options, device and sizes of all rows
//! - `forward`: rows without gradient
//! - `step`: rows of whole updates
//! - `clustering`: the K-means row

pub(crate) mod case;
pub(crate) mod clustering;
pub(crate) mod context;
pub(crate) mod forward;
pub(crate) mod reference;
pub(crate) mod step;
pub(crate) mod task;
