//! The HTML report.
//!
//! - `plot`: SVG plots
//! - `plots`: plots of a summary
//! - `page`: the HTML page

pub(crate) mod page;
pub(crate) mod plot;
pub(crate) mod plots;
