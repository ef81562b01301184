//! The target views of a scene as one key renders them, and the results of the scene, from which its contact sheet is made.

use std::collections::BTreeMap;

use clift_data::Clip;

use crate::config::method::Method;
use crate::error::EvalError;
use crate::statistics::view_metrics::{EvalKey, ViewMetrics};
use crate::sweep::view_scorer::ViewScorer;
use clift_scene::{mean_image, nearest_image};

/// The scored target views of a scene under one key.
pub(crate) struct ScoredViews {
    pub key: EvalKey,
    /// Metrics by target view.
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
        Ok(self.metrics.entry(view).or_insert(metrics))
    }
}

pub(crate) const MAX_KEPT_VIEWS: usize = 6;

pub(crate) struct SceneResults {
    /// The renderings of every key: baselines first.
    pub renderings: Vec<ScoredViews>,
    /// The target views whose images are kept; at least one.
    pub kept_views: Vec<usize>,
}

/// Returns all of `0..count`, or `most` of them from the first to the last; `most` is at least 2.
pub(crate) fn spread(count: usize, most: usize) -> Vec<usize> {
    if count <= most {
        return (0..count).collect();
    }
    (0..most).map(|i| i * (count - 1) / (most - 1)).collect()
}

pub(crate) fn baselines(clip: &Clip, scorer: &ViewScorer, kept_views: &[usize]) -> Result<Vec<ScoredViews>, EvalError> {
    let mean = mean_image(&clip.context)?;
    let mut nearest = ScoredViews::new(EvalKey::baseline(Method::NearestView));
    let mut means = ScoredViews::new(EvalKey::baseline(Method::MeanImage));
    for (view, camera) in clip.target.cameras.iter().enumerate() {
        nearest.add(view, nearest_image(&clip.context, camera.c2w)?, scorer, kept_views)?;
        means.add(view, mean.clone(), scorer, kept_views)?;
    }
    Ok(vec![nearest, means])
}
