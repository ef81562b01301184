//! Means over the views of a scene first and over the scenes then, so that a scene with many targets weighs no more
//! than one with few.

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

/// Returns the mean; `None` for no values.
pub(crate) fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// Returns the sample standard deviation over the square root of the count; `None` below two values.
pub(crate) fn standard_error(values: &[f64]) -> Option<f64> {
    let count = values.len() as f64;
    let mean = mean(values)?;
    let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    (values.len() > 1).then(|| (squares / (count - 1.0) / count).sqrt())
}
