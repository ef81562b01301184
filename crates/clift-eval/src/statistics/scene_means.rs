//! Means over the views of a scene first and over the scenes then, so that a scene with many targets weighs no more
//! than one with few.

use clift_data::mean;

use crate::statistics::eval_results::SceneViews;
use crate::statistics::view_metrics::ViewMetrics;

/// What an identical image counts as in a mean, in dB; larger values are counted as this too.
///
/// Its PSNR is infinite, which no mean survives and JSON cannot hold. 100 dB is what one wrong 8-bit
/// level in one of the values of a 256 x 256 image gives (101 dB), so nothing real is cut off.
/// Leaving such views out instead would lower the mean of the method that got them right.
pub const PSNR_CAP_DB: f64 = 100.0;

/// Limits a PSNR to [`PSNR_CAP_DB`].
pub(crate) fn capped(psnr: f64) -> f64 {
    psnr.min(PSNR_CAP_DB)
}

/// Returns the mean over the views of each scene, for the scenes that have a value.
pub(crate) fn scene_means(views: &SceneViews, value: impl Fn(&ViewMetrics) -> Option<f64>) -> Vec<f64> {
    views.values().filter_map(|frames| mean(&frames.values().filter_map(&value).collect::<Vec<_>>())).collect()
}
