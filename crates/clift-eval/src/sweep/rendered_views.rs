//! The target views of a scene as one key renders them: metrics, and images for the figures.

use std::collections::BTreeMap;

use clift_data::Clip;

use crate::config::method::Method;
use crate::error::EvalError;
use crate::statistics::view_metrics::{EvalKey, ViewMetrics};
use crate::sweep::baselines::{mean_image, nearest_image};
use crate::sweep::view_scorer::ViewScorer;

/// The scored target views of a scene under one key.
pub(crate) struct ScoredViews {
    pub key: EvalKey,
    /// Metrics by target view. Only an external method can miss views.
    pub metrics: BTreeMap<usize, ViewMetrics>,
    /// Kept images by target view, `[height, width, 3]` in `[0, 1]`.
    pub images: BTreeMap<usize, Vec<f32>>,
}

impl ScoredViews {
    pub fn new(key: EvalKey) -> Self {
        Self { key, metrics: BTreeMap::new(), images: BTreeMap::new() }
    }

    /// Scores the image of a target view, and keeps the image of a view in `kept_views`.
    pub fn add(
        &mut self,
        view: usize,
        pixels: Vec<f32>,
        scorer: &ViewScorer,
        kept_views: &[usize],
    ) -> Result<&mut ViewMetrics, EvalError> {
        let metrics = scorer.measure(&pixels, view)?;
        if kept_views.contains(&view) {
            self.images.insert(view, pixels);
        }
        Ok(self.metrics.entry(view).insert_entry(metrics).into_mut())
    }
}

/// Scores both baselines: the nearest context view and the mean of the context views.
pub(crate) fn baselines(clip: &Clip, scorer: &ViewScorer, kept_views: &[usize]) -> Result<Vec<ScoredViews>, EvalError> {
    let mean = mean_image(&clip.context)?;
    let mut nearest = ScoredViews::new(EvalKey::baseline(Method::NearestView));
    let mut means = ScoredViews::new(EvalKey::baseline(Method::MeanImage));
    for (view, &pose) in clip.target.c2w.iter().enumerate() {
        nearest.add(view, nearest_image(&clip.context, pose)?, scorer, kept_views)?;
        means.add(view, mean.clone(), scorer, kept_views)?;
    }
    Ok(vec![nearest, means])
}
