//! The HTML report.
//!
//! - `axis`: plot axes and ticks
//! - `html`: data URIs; escaping by maud
//! - `plot`: SVG plots
//! - `plots`: plots of a summary
//! - `training`: training curves
//! - `scene_section`: one scene on the page
//! - `tables`: tables of the page
//! - `page`: the HTML page

pub(crate) mod axis;
pub(crate) mod html;
pub(crate) mod page;
pub(crate) mod plot;
pub(crate) mod plots;
pub(crate) mod scene_section;
pub(crate) mod tables;
pub(crate) mod training;
