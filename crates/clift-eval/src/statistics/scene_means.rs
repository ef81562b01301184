//! Means over the views of a scene, then over the scenes, so every scene has the same weight.

use clift_data::mean;

use crate::statistics::eval_results::SceneViews;
use crate::statistics::view_metrics::ViewMetrics;

/// Upper bound of a PSNR in a mean, in dB, for identical images with their infinite PSNR.
///
/// A mean cannot hold infinity, nor can JSON. A single wrong 8-bit level in a 256 x 256 image has 101 dB, so the bound
/// affects no real difference. Skipping identical views would lower the mean of the better method.
pub const PSNR_CAP_DB: f64 = 100.0;

/// Limits a PSNR to [`PSNR_CAP_DB`].
pub(crate) fn capped(psnr: f64) -> f64 {
    psnr.min(PSNR_CAP_DB)
}

/// Returns the mean over the views of each scene, for the scenes that have a value.
pub(crate) fn scene_means(views: &SceneViews, value: impl Fn(&ViewMetrics) -> Option<f64>) -> Vec<f64> {
    views.values().filter_map(|frames| mean(&frames.values().filter_map(&value).collect::<Vec<_>>())).collect()
}
