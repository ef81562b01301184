//! Scores renderings of a scene's target views.

use std::cell::RefCell;
use std::collections::BTreeMap;

use clift_data::ClipViews;

use crate::error::EvalError;
use crate::metrics::image_metrics::{SSIM_MIN_SIZE_PX, psnr, ssim};
use crate::metrics::lpips::{LPIPS_MIN_SIZE_PX, Lpips, LpipsFeatures};
use crate::statistics::view_metrics::ViewMetrics;

/// Memory for what LPIPS sees in the targets of a scene, which every setting is compared with: 31 pictures of
/// 256 x 256. What it sees in further ones is computed each time.
const KEPT_BYTES: usize = 1 << 30;

/// Compares renderings of a scene with its target views.
pub(crate) struct ViewScorer<'a> {
    target: &'a ClipViews,
    lpips: Option<&'a Lpips>,
    kept: RefCell<(usize, BTreeMap<usize, LpipsFeatures>)>,
}

impl<'a> ViewScorer<'a> {
    pub fn new(target: &'a ClipViews, lpips: Option<&'a Lpips>) -> Self {
        let lpips = lpips.filter(|_| target.height.min(target.width) >= LPIPS_MIN_SIZE_PX);
        Self { target, lpips, kept: RefCell::default() }
    }

    /// Measures a rendering of a target; a metric whose window the picture is too small for is left out.
    pub fn measure(&self, pixels: &[f32], view: usize) -> Result<ViewMetrics, EvalError> {
        let truth = target_image(self.target, view);
        let (height, width) = (self.target.height, self.target.width);
        let large_enough = height.min(width) >= SSIM_MIN_SIZE_PX;
        let ssim = if large_enough { Some(ssim(pixels, &truth, height, width)?) } else { None };
        let lpips_vgg = match self.lpips {
            Some(lpips) => Some(self.lpips(lpips, pixels, &truth, view)?),
            None => None,
        };
        Ok(ViewMetrics { lpips_vgg, ..ViewMetrics::quality(psnr(pixels, &truth)?, ssim) })
    }

    fn lpips(&self, lpips: &Lpips, pixels: &[f32], truth: &[f32], view: usize) -> Result<f64, EvalError> {
        let (height, width) = (self.target.height, self.target.width);
        let seen = lpips.features(pixels, height, width)?;
        if let Some(truth) = self.kept.borrow().1.get(&view) {
            return lpips.distance(&seen, truth);
        }
        let truth = lpips.features(truth, height, width)?;
        let distance = lpips.distance(&seen, &truth)?;
        let (bytes, kept) = &mut *self.kept.borrow_mut();
        if *bytes + truth.num_bytes() <= KEPT_BYTES {
            *bytes += truth.num_bytes();
            kept.insert(view, truth);
        }
        Ok(distance)
    }
}

/// Ground truth of one target in `[0, 1]`.
pub(crate) fn target_image(target: &ClipViews, view: usize) -> Vec<f32> {
    let len = target.height * target.width * 3;
    target.images[view * len..(view + 1) * len].iter().map(|&value| f32::from(value) / 255.0).collect()
}
