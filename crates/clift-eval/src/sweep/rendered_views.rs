//! The targets of a scene in one setting: measured, and kept where they are to be shown.

use std::collections::BTreeMap;

use clift_data::Clip;

use crate::config::method::Method;
use crate::error::EvalError;
use crate::statistics::view_metrics::{EvalKey, ViewMetrics};
use crate::sweep::baselines::{mean_image, nearest_image};
use crate::sweep::view_scorer::ViewScorer;

/// All targets of a scene in one setting.
pub(crate) struct ScoredViews {
    /// How they were made.
    pub setting: EvalKey,
    /// By view.
    pub measured: Vec<ViewMetrics>,
    /// The pictures that are shown, by view: `height * width * 3` values of RGB.
    pub shown: BTreeMap<usize, Vec<f32>>,
}

impl ScoredViews {
    pub fn new(setting: EvalKey) -> Self {
        Self { setting, measured: Vec::new(), shown: BTreeMap::new() }
    }

    /// Measures the next view, and keeps its picture if it is to be shown.
    pub fn add(&mut self, pixels: Vec<f32>, scorer: &ViewScorer, rows: &[usize]) -> Result<(), EvalError> {
        let view = self.measured.len();
        self.measured.push(scorer.measure(&pixels, view)?);
        if rows.contains(&view) {
            self.shown.insert(view, pixels);
        }
        Ok(())
    }
}

/// What every method must beat, measured.
pub(crate) fn baselines(clip: &Clip, scorer: &ViewScorer, rows: &[usize]) -> Result<Vec<ScoredViews>, EvalError> {
    let mean = mean_image(&clip.context)?;
    let mut nearest = ScoredViews::new(EvalKey::baseline(Method::NearestView));
    let mut means = ScoredViews::new(EvalKey::baseline(Method::MeanImage));
    for &pose in &clip.target.c2w {
        nearest.add(nearest_image(&clip.context, pose)?, scorer, rows)?;
        means.add(mean.clone(), scorer, rows)?;
    }
    Ok(vec![nearest, means])
}
