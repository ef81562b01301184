//! What is measured of a view, and the key of its row in tables and files.

use std::collections::BTreeSet;

use clift_model::TokenFormat;

use crate::config::method::Method;

/// What views are averaged over: method, token counts and number format. The order is that of the files: variant,
/// then fewer tokens.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct EvalKey {
    /// How the views were made.
    pub variant: Method,
    /// Tokens in the scene file; 0 for a baseline.
    pub num_storage_tokens: usize,
    /// Tokens the renderer was given; 0 for a baseline.
    pub num_render_tokens: usize,
    /// Number format of the stored tokens; none where there are none.
    pub tokens: Option<TokenFormat>,
}

impl EvalKey {
    /// Returns the key of a baseline or of another system, which has no tokens.
    pub const fn baseline(variant: Method) -> Self {
        Self { variant, num_storage_tokens: 0, num_render_tokens: 0, tokens: None }
    }

    /// Returns the name of the number format, empty where there is none.
    pub fn format_name(self) -> &'static str {
        self.tokens.map_or("", TokenFormat::name)
    }

    /// Returns whether views are rendered from all stored tokens.
    pub const fn is_whole(self) -> bool {
        self.num_render_tokens == self.num_storage_tokens
    }
}

/// Returns the variant that stands for the method: the condensed one where there is a condenser.
pub(crate) fn best_variant(keys: impl IntoIterator<Item = EvalKey>) -> Option<Method> {
    let there: BTreeSet<Method> = keys.into_iter().map(|key| key.variant).collect();
    [Method::Clift, Method::PatchClift, Method::Kmeans, Method::Random]
        .into_iter()
        .find(|variant| there.contains(variant))
}

/// The metrics of one view; `None` is what was not measured.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ViewMetrics {
    /// Peak signal-to-noise ratio in dB; infinite for an identical image.
    pub psnr: f64,
    /// Structural similarity; `None` below 11 x 11 pixels.
    pub ssim: Option<f64>,
    /// LPIPS with VGG-16; `None` without its weights and below 16 x 16 pixels.
    pub lpips_vgg: Option<f64>,
    /// Seconds the renderer took for this view alone, from tokens to pixels.
    pub render_s: Option<f64>,
    /// Seconds token selection took.
    pub select_s: Option<f64>,
}

impl ViewMetrics {
    /// Returns the time per frame: token selection, if any, and rendering.
    pub fn frame_s(&self) -> Option<f64> {
        self.render_s.map(|render_s| render_s + self.select_s.unwrap_or_default())
    }

    /// Returns metrics with PSNR and SSIM only.
    pub const fn quality(psnr: f64, ssim: Option<f64>) -> Self {
        Self { psnr, ssim, lpips_vgg: None, render_s: None, select_s: None }
    }
}

/// Cost of a key, the same for every view; `None` is what was not computed.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Cost {
    /// Billions of multiply-accumulates per rendered view, attention included.
    pub gflops: Option<f64>,
    /// Bytes of a scene file, or the data size that was given for another system.
    pub scene_bytes: Option<u64>,
    /// Peak memory of the whole process while a view was rendered.
    pub peak_bytes: Option<u64>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_condensed_variant_stands_for_the_method_where_it_is_there() {
        let keys = [Method::NearestView, Method::Random, Method::Kmeans].map(EvalKey::baseline);
        assert_eq!(best_variant(keys), Some(Method::Kmeans));
        assert_eq!(best_variant(keys.into_iter().chain([EvalKey::baseline(Method::Clift)])), Some(Method::Clift));
        assert_eq!(best_variant([EvalKey::baseline(Method::MeanImage)]), None);
    }
}
