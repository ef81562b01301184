//! The targets of a scene in one setting: measured, and kept where they are to be shown.

use std::cell::RefCell;
use std::collections::BTreeMap;

use clift_data::{Clip, Views as HostViews};

use crate::EvalError;
use crate::baseline::{mean_image, nearest_image};
use crate::lpips::{LPIPS_MIN_SIZE_PX, Lpips, LpipsFeatures};
use crate::method::Variant;
use crate::metrics::{SSIM_MIN_SIZE_PX, psnr, ssim};
use crate::view_metrics::{EvalKey, ViewMetrics};

/// Memory for what LPIPS sees in the targets of a scene, which every setting is compared with: 31 pictures of
/// 256 x 256. What it sees in further ones is computed each time.
const KEPT_BYTES: usize = 1 << 30;

/// What renderings of a scene are measured with.
pub(crate) struct Judge<'a> {
    target: &'a HostViews,
    lpips: Option<&'a Lpips>,
    kept: RefCell<(usize, BTreeMap<usize, LpipsFeatures>)>,
}

impl<'a> Judge<'a> {
    pub fn new(target: &'a HostViews, lpips: Option<&'a Lpips>) -> Self {
        let lpips = lpips.filter(|_| target.height.min(target.width) >= LPIPS_MIN_SIZE_PX);
        Self { target, lpips, kept: RefCell::default() }
    }

    /// Measures a rendering of a target; a metric whose window the picture is too small for is left out.
    pub fn measure(&self, pixels: &[f32], view: usize) -> Result<ViewMetrics, EvalError> {
        let truth = truth(self.target, view);
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

/// All targets of a scene in one setting.
pub(crate) struct Rendered {
    /// How they were made.
    pub setting: EvalKey,
    /// By view.
    pub measured: Vec<ViewMetrics>,
    /// The pictures that are shown, by view: `height * width * 3` values of RGB.
    pub shown: BTreeMap<usize, Vec<f32>>,
}

impl Rendered {
    pub fn new(setting: EvalKey) -> Self {
        Self { setting, measured: Vec::new(), shown: BTreeMap::new() }
    }

    /// Measures the next view, and keeps its picture if it is to be shown.
    pub fn add(&mut self, pixels: Vec<f32>, judge: &Judge, rows: &[usize]) -> Result<(), EvalError> {
        let view = self.measured.len();
        self.measured.push(judge.measure(&pixels, view)?);
        if rows.contains(&view) {
            self.shown.insert(view, pixels);
        }
        Ok(())
    }
}

/// What every method must beat, measured.
pub(crate) fn baselines(clip: &Clip, judge: &Judge, rows: &[usize]) -> Result<Vec<Rendered>, EvalError> {
    let mean = mean_image(&clip.context)?;
    let mut nearest = Rendered::new(EvalKey::baseline(Variant::NearestView));
    let mut means = Rendered::new(EvalKey::baseline(Variant::MeanImage));
    for &pose in &clip.target.c2w {
        nearest.add(nearest_image(&clip.context, pose)?, judge, rows)?;
        means.add(mean.clone(), judge, rows)?;
    }
    Ok(vec![nearest, means])
}

/// Ground truth of one target in `[0, 1]`.
pub(crate) fn truth(target: &HostViews, view: usize) -> Vec<f32> {
    let len = target.height * target.width * 3;
    target.images[view * len..(view + 1) * len].iter().map(|&value| f32::from(value) / 255.0).collect()
}
