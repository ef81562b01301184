//! Time of a run, from short measurements.
//!
//! - `calibration`: time a shallow network
//! - `plan`: memory and time of a run

pub(crate) mod calibration;
pub(crate) mod plan;
