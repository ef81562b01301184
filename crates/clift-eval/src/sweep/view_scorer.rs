//! Scores renderings of a scene's target views.

use std::cell::RefCell;
use std::collections::BTreeMap;

use clift_core::ClipViews;
use clift_data::Clip;
use clift_model::{LPIPS_MIN_SIZE_PX, Lpips, LpipsFeatures, SSIM_MIN_SIZE_PX, psnr, sharpness, ssim};
use clift_scene::view_image;

use crate::error::EvalError;
use crate::statistics::view_metrics::ViewMetrics;

/// Memory for the LPIPS features of the target views, which every key is compared with: 31 images of 256 x 256. The
/// features of further targets are computed every time.
const MAX_CACHED_BYTES: usize = 1 << 30;

pub(crate) struct ViewScorer<'a> {
    target: &'a ClipViews,
    /// As [`Clip::target_weights`].
    weights: Option<&'a [u8]>,
    lpips: Option<&'a Lpips>,
    /// Bytes of the cached features, and the features by target view.
    cache: RefCell<(usize, BTreeMap<usize, LpipsFeatures>)>,
}

impl<'a> ViewScorer<'a> {
    pub fn new(clip: &'a Clip, lpips: Option<&'a Lpips>) -> Self {
        let Clip { target, target_weights, .. } = clip;
        let lpips = lpips.filter(|_| target.height.min(target.width) >= LPIPS_MIN_SIZE_PX);
        Self { target, weights: target_weights.as_deref(), lpips, cache: RefCell::default() }
    }

    /// Returns the weights of the pixels of a view, in `0..=255`, and the share that counts. `None` where every pixel
    /// counts, and where none does: such a target is measured whole.
    pub fn weights(&self, view: usize) -> Option<(&'a [u8], f64)> {
        let num_pixels = self.target.height * self.target.width;
        let weights = &self.weights?[view * num_pixels..][..num_pixels];
        let sum: u64 = weights.iter().map(|weight| u64::from(*weight)).sum();
        let share = sum as f64 / (255 * num_pixels) as f64;
        (share > 0.0 && share < 1.0).then_some((weights, share))
    }

    /// Measures a rendering of a target view. Metrics that need a larger image are `None`.
    ///
    /// Pixels that do not count are replaced by the target's, and errors are divided by the share of the others: the mean
    /// squared error is that of the pixels that count; SSIM and LPIPS, which see neighbourhoods, are approximations.
    pub fn measure(&self, pixels: &[f32], view: usize) -> Result<ViewMetrics, EvalError> {
        let Some((weights, share)) = self.weights(view) else { return self.measure_whole(pixels, view, None) };
        let target = view_image(self.target, view);
        let mut pixels = pixels.to_vec();
        for ((pixel, target), weight) in pixels.chunks_exact_mut(3).zip(target.chunks_exact(3)).zip(weights) {
            let weight = f32::from(*weight) / 255.0;
            pixel.iter_mut().zip(target).for_each(|(pixel, target)| *pixel = target + (*pixel - target) * weight);
        }
        let whole = self.measure_whole(&pixels, view, Some(weights))?;
        Ok(ViewMetrics {
            psnr: whole.psnr + 10.0 * share.log10(),
            ssim: whole.ssim.map(|ssim| 1.0 - (1.0 - ssim) / share),
            lpips_vgg: whole.lpips_vgg.map(|lpips| lpips / share),
            ..whole
        })
    }

    /// Measures all pixels; sharpness by their `weights`.
    fn measure_whole(&self, pixels: &[f32], view: usize, weights: Option<&[u8]>) -> Result<ViewMetrics, EvalError> {
        let target = view_image(self.target, view);
        let (height, width) = (self.target.height, self.target.width);
        let has_ssim = height.min(width) >= SSIM_MIN_SIZE_PX;
        let ssim = has_ssim.then(|| ssim(pixels, &target, height, width)).transpose()?;
        let lpips_vgg = self.lpips.map(|lpips| self.lpips_distance(lpips, pixels, &target, view)).transpose()?;
        let sharpness = sharpness(pixels, &target, [height, width], weights)?;
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::gray_views;
    use clift_core::Pose;

    #[test]
    fn masked_pixels_do_not_count() {
        // Columns of 20 x 12 pixels: the left half counts. There, a rendering is off by 0.1.
        let views = |level: u8| gray_views((20, 12), level, vec![Pose::IDENTITY; 2], vec![0, 1]);
        let row = [[255; 10], [0; 10]].concat();
        let weights = [row.repeat(12), vec![0; 240]].concat();
        let clip = Clip { key: "a".into(), context: views(0), target: views(0), target_weights: Some(weights) };
        let scorer = ViewScorer::new(&clip, None);
        let left = [[0.1; 30], [0.9; 30]].concat().repeat(12);
        let measured = scorer.measure(&left, 0).unwrap();
        assert!((measured.psnr - 20.0).abs() < 1e-5, "{measured:?}");
        assert!(measured.ssim.unwrap() < 0.5, "{measured:?}");
        assert_eq!(measured.sharpness, None, "the target has no contrast");
        assert_eq!(scorer.weights(0).map(|(_, share)| share), Some(0.5));
        // Nothing counts in the second view: it is measured whole.
        assert_eq!(scorer.weights(1), None);
        assert_eq!(scorer.measure(&[1.0; 720], 1).unwrap().psnr, 0.0);
        let whole = Clip { target_weights: None, ..clip.clone() };
        assert!(ViewScorer::new(&whole, None).measure(&left, 0).unwrap().psnr < 5.0);
    }
}
