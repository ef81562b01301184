//! The metrics of a view, and the key of a row in tables and files.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;

use clift_core::mean;
use clift_scene::TokenCoding;
use serde::{Deserialize, Serialize};

use crate::config::method::Method;

/// The key that views are averaged under: method, token counts and number format. Keys are ordered as in the files: by
/// method, then by ascending token counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct EvalKey {
    pub method: Method,
    /// Tokens in the scene file; 0 for a baseline.
    pub num_storage_tokens: usize,
    /// Tokens of a rendering; 0 for a baseline.
    pub num_render_tokens: usize,
    pub tokens: Option<TokenCoding>,
}

impl EvalKey {
    pub const fn baseline(method: Method) -> Self {
        Self { method, num_storage_tokens: 0, num_render_tokens: 0, tokens: None }
    }

    pub const fn is_whole(self) -> bool {
        self.num_render_tokens == self.num_storage_tokens
    }
}

impl fmt::Display for EvalKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { method, num_storage_tokens: stored, num_render_tokens: rendered, tokens } = self;
        f.write_str(method.name())?;
        match (stored, stored == rendered) {
            (0, _) => {}
            (_, true) => write!(f, " {stored}")?,
            (_, false) => write!(f, " {rendered} of {stored}")?,
        }
        tokens.map_or(Ok(()), |tokens| write!(f, " {tokens}"))
    }
}

/// Returns the main method among the keys: a condensed method, else K-means, else random tokens, else a
/// network without clusters.
pub(crate) fn best_method(keys: impl IntoIterator<Item = EvalKey>) -> Option<Method> {
    let found: BTreeSet<Method> = keys.into_iter().map(|key| key.method).collect();
    [Method::Clift, Method::TileClift, Method::Kmeans, Method::Random]
        .into_iter()
        .chain(Method::whole())
        .find(|method| found.contains(method))
}

/// Upper bound of a PSNR in a mean, in dB, for identical images with their infinite PSNR.
///
/// A mean cannot hold infinity, nor can JSON. A single wrong 8-bit level in a 256 x 256 image has 101 dB, so the bound
/// affects no real difference. Skipping identical views would lower the mean of the better method.
pub const PSNR_CAP_DB: f64 = 100.0;

/// The metrics of one view; `None` was not measured.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ViewMetrics {
    /// Peak signal-to-noise ratio in dB; infinite for an identical image.
    pub psnr: f64,
    /// Structural similarity; `None` below 11 x 11 pixels.
    pub ssim: Option<f64>,
    /// LPIPS with VGG-16; `None` without its weights and below 16 x 16 pixels.
    pub lpips_vgg: Option<f64>,
    /// Mean gradient magnitude over that of the target; `None` for a target without contrast.
    pub sharpness: Option<f64>,
    /// Rendering time of this view, from tokens to pixels, in seconds.
    pub render_s: Option<f64>,
    pub select_s: Option<f64>,
}

impl ViewMetrics {
    /// Returns the time per frame: token selection, if any, and rendering.
    pub fn frame_s(&self) -> Option<f64> {
        self.render_s.map(|render_s| render_s + self.select_s.unwrap_or_default())
    }

    pub const fn quality(psnr: f64, ssim: Option<f64>) -> Self {
        Self { psnr, ssim, lpips_vgg: None, sharpness: None, render_s: None, select_s: None }
    }
}

/// A value of a view that is averaged; `None` where it was not measured.
pub(crate) type Metric = fn(&ViewMetrics) -> Option<f64>;

/// PSNR as it counts in a mean, at most [`PSNR_CAP_DB`].
pub(crate) const PSNR: Metric = |view| Some(view.psnr.min(PSNR_CAP_DB));
/// PSNR, SSIM, LPIPS and sharpness, the order in which their means are taken apart.
pub(crate) const METRICS: [Metric; 4] = [PSNR, |view| view.ssim, |view| view.lpips_vgg, |view| view.sharpness];

/// Returns the mean over the views of a scene that have the metric, by target frame; `None` without one.
pub(crate) fn view_mean(views: &BTreeMap<usize, ViewMetrics>, metric: Metric) -> Option<f64> {
    mean(&views.values().filter_map(metric).collect::<Vec<_>>())
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Cost {
    /// Billions of multiply-accumulates per rendered view, attention included.
    pub gflops: Option<f64>,
    /// Values of the stored tokens: tokens times their width.
    pub scene_values: Option<u64>,
    pub scene_bytes: Option<u64>,
    /// Mean bytes of a scene file as `clift encode` writes it by default: of condensed tokens with a codec.
    pub coded_bytes: Option<u64>,
    /// Peak resident memory of the process, weights included, while a view was rendered; on CPUs only.
    pub peak_bytes: Option<u64>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn condensed_methods_come_first() {
        let keys = [Method::NearestView, Method::Random, Method::Kmeans].map(EvalKey::baseline);
        assert_eq!(best_method(keys), Some(Method::Kmeans));
        assert_eq!(best_method(keys.into_iter().chain([EvalKey::baseline(Method::Clift)])), Some(Method::Clift));
        assert_eq!(best_method([EvalKey::baseline(Method::MeanImage)]), None);
    }
}
