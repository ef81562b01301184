//! Scores renderings of a scene's target views.

use std::cell::RefCell;
use std::collections::BTreeMap;

use clift_core::ClipViews;
use clift_model::{LPIPS_MIN_SIZE_PX, Lpips, LpipsFeatures, SSIM_MIN_SIZE_PX, psnr, sharpness, ssim};

use crate::error::EvalError;
use crate::statistics::view_metrics::ViewMetrics;
use clift_scene::view_image;

/// Memory for the LPIPS features of the target views, which every key is compared with: 31 images of 256 x 256. The
/// features of further targets are computed every time.
const MAX_CACHED_BYTES: usize = 1 << 30;

/// Compares renderings of a scene with its target views.
pub(crate) struct ViewScorer<'a> {
    target: &'a ClipViews,
    lpips: Option<&'a Lpips>,
    /// Bytes of the cached features, and the features by target view.
    cache: RefCell<(usize, BTreeMap<usize, LpipsFeatures>)>,
}

impl<'a> ViewScorer<'a> {
    pub fn new(target: &'a ClipViews, lpips: Option<&'a Lpips>) -> Self {
        let lpips = lpips.filter(|_| target.height.min(target.width) >= LPIPS_MIN_SIZE_PX);
        Self { target, lpips, cache: RefCell::default() }
    }

    /// Measures a rendering of a target view. Metrics that need a larger image are `None`.
    pub fn measure(&self, pixels: &[f32], view: usize) -> Result<ViewMetrics, EvalError> {
        let target = view_image(self.target, view);
        let (height, width) = (self.target.height, self.target.width);
        let has_ssim = height.min(width) >= SSIM_MIN_SIZE_PX;
        let ssim = has_ssim.then(|| ssim(pixels, &target, height, width)).transpose()?;
        let lpips_vgg = self.lpips.map(|lpips| self.lpips_distance(lpips, pixels, &target, view)).transpose()?;
        let sharpness = sharpness(pixels, &target, height, width)?;
        Ok(ViewMetrics { lpips_vgg, sharpness, ..ViewMetrics::quality(psnr(pixels, &target)?, ssim) })
    }

    fn lpips_distance(&self, lpips: &Lpips, pixels: &[f32], target: &[f32], view: usize) -> Result<f64, EvalError> {
        let (height, width) = (self.target.height, self.target.width);
        let features = lpips.features(pixels, height, width)?;
        if let Some(target) = self.cache.borrow().1.get(&view) {
            return Ok(lpips.distance(&features, target)?);
        }
        let target = lpips.features(target, height, width)?;
        let distance = lpips.distance(&features, &target)?;
        let (bytes, cached) = &mut *self.cache.borrow_mut();
        if *bytes + target.num_bytes() <= MAX_CACHED_BYTES {
            *bytes += target.num_bytes();
            cached.insert(view, target);
        }
        Ok(distance)
    }
}
