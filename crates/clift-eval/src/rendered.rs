//! The targets of a scene in one setting: measured, and kept where they are to be shown.

use std::collections::BTreeMap;

use clift_data::{Clip, Views as HostViews};

use crate::EvalError;
use crate::baseline::{mean_image, nearest_image};
use crate::measured::{Measured, Setting, Variant};
use crate::metrics::{SSIM_MIN_SIZE_PX, psnr, ssim};

/// All targets of a scene in one setting.
pub(crate) struct Rendered {
    /// How they were made.
    pub setting: Setting,
    /// By view.
    pub measured: Vec<Measured>,
    /// The pictures that are shown, by view: `height * width * 3` values of RGB.
    pub shown: BTreeMap<usize, Vec<f32>>,
}

impl Rendered {
    pub fn new(setting: Setting) -> Self {
        Self { setting, measured: Vec::new(), shown: BTreeMap::new() }
    }

    /// Measures the next view, and keeps its picture if it is to be shown.
    pub fn add(&mut self, pixels: Vec<f32>, target: &HostViews, rows: &[usize]) -> Result<(), EvalError> {
        let view = self.measured.len();
        self.measured.push(measure(&pixels, target, view)?);
        if rows.contains(&view) {
            self.shown.insert(view, pixels);
        }
        Ok(())
    }
}

/// What every method must beat, measured.
pub(crate) fn baselines(clip: &Clip, rows: &[usize]) -> Result<Vec<Rendered>, EvalError> {
    let mean = mean_image(&clip.context)?;
    let mut nearest = Rendered::new(Setting::baseline(Variant::NearestView));
    let mut means = Rendered::new(Setting::baseline(Variant::MeanImage));
    for &pose in &clip.target.c2w {
        nearest.add(nearest_image(&clip.context, pose)?, &clip.target, rows)?;
        means.add(mean.clone(), &clip.target, rows)?;
    }
    Ok(vec![nearest, means])
}

/// Ground truth of one target in `[0, 1]`.
pub(crate) fn truth(target: &HostViews, view: usize) -> Vec<f32> {
    let len = target.height * target.width * 3;
    target.images[view * len..(view + 1) * len].iter().map(|&value| f32::from(value) / 255.0).collect()
}

fn measure(pixels: &[f32], target: &HostViews, view: usize) -> Result<Measured, EvalError> {
    let truth = truth(target, view);
    let (height, width) = (target.height, target.width);
    let large_enough = height.min(width) >= SSIM_MIN_SIZE_PX;
    let ssim = if large_enough { Some(ssim(pixels, &truth, height, width)?) } else { None };
    Ok(Measured::quality(psnr(pixels, &truth)?, ssim))
}
