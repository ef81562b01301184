//! The metrics of every view of an evaluation.

use std::collections::{BTreeMap, BTreeSet};

use clift_core::mean;
use serde::{Deserialize, Serialize};

use crate::config::split::EvalSplit;
use crate::config::token_selection::Selection;
use crate::statistics::view_metrics::{Cost, EvalKey, ViewMetrics};

/// A metric that was not measured.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct NotMeasured {
    /// Name of the metric.
    pub metric: String,
    /// Reason and remedy.
    pub reason: String,
}

/// Context views that were rendered themselves.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ContextCheck {
    /// Rendered context views.
    pub num_views: usize,
    /// Those that came out as fog: below [`MIN_CONTEXT_PSNR`](clift_scene::MIN_CONTEXT_PSNR) or the mean of the contexts.
    pub num_fog: usize,
}

/// What `summary.json` has beside the numbers.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Facts {
    /// Origin of the views; `None` if unknown.
    pub split: Option<EvalSplit>,
    /// Context frames of every measured scene.
    pub context_frames: BTreeMap<String, Vec<usize>>,
    /// The context views, rendered from all tokens; `None` on the data of a run's own training.
    pub context_check: Option<ContextCheck>,
    /// Keys of the scenes that the models were trained on.
    pub training_scenes: BTreeSet<String>,
    /// How rendered tokens were selected; `None` where every view was rendered from all stored tokens.
    pub selection: Option<Selection>,
    pub lpips_weights_sha256: Option<String>,
    /// Metrics that were measured nowhere, with reasons.
    pub not_measured: Vec<NotMeasured>,
}

/// The views of one key, by scene and target frame.
pub type SceneViews = BTreeMap<String, BTreeMap<usize, ViewMetrics>>;

/// The results of an evaluation. Output files do not depend on the order in which views are added.
#[derive(Clone, Debug, Default)]
pub struct EvalResults {
    views: BTreeMap<EvalKey, SceneViews>,
    /// Cost of every key of which a warm-up view was rendered.
    pub(crate) costs: BTreeMap<EvalKey, Cost>,
    /// Sizes of the scene files of every key: in its format, and in the default format of `clift encode`.
    bytes: BTreeMap<EvalKey, [Vec<u64>; 2]>,
    pub(crate) skipped: BTreeSet<String>,
    pub(crate) facts: Facts,
    /// Scene and frame of the targets that are also contexts.
    pub(crate) context_targets: BTreeSet<(String, usize)>,
    /// Share of the pixels that masks leave out, of targets with a mask, by scene and frame.
    pub(crate) masked: BTreeMap<String, BTreeMap<usize, f64>>,
}

impl EvalResults {
    /// Adds one view of a scene. Of two results for a view under one key the first counts. Returns whether the view is new.
    pub fn add(&mut self, scene: &str, frame: usize, key: EvalKey, view: ViewMetrics) -> bool {
        let frames = self.views.entry(key).or_default().entry(scene.to_owned()).or_default();
        let num_views = frames.len();
        frames.entry(frame).or_insert(view);
        frames.len() > num_views
    }

    /// Returns the context frames of a scene, separated by spaces.
    pub(crate) fn context_list(&self, scene: &str) -> Option<String> {
        let frames = self.facts.context_frames.get(scene)?;
        Some(frames.iter().map(ToString::to_string).collect::<Vec<_>>().join(" "))
    }

    /// Iterates over the views of every key, in the order of keys.
    pub fn views(&self) -> impl Iterator<Item = (EvalKey, &SceneViews)> {
        self.views.iter().map(|(key, views)| (*key, views))
    }

    /// Returns the views of one key.
    pub fn of(&self, key: EvalKey) -> Option<&SceneViews> {
        self.views.get(&key)
    }

    /// Records the size of a scene file.
    pub(crate) fn add_scene_bytes(&mut self, key: EvalKey, bytes: u64) {
        self.bytes.entry(key).or_default()[0].push(bytes);
    }

    /// Records the size of a scene file with the default coding.
    pub(crate) fn add_coded_bytes(&mut self, key: EvalKey, bytes: u64) {
        self.bytes.entry(key).or_default()[1].push(bytes);
    }

    /// Returns the cost of a key, with the mean sizes over scenes.
    pub(crate) fn cost(&self, key: EvalKey) -> Cost {
        let mut cost = self.costs.get(&key).copied().unwrap_or_default();
        if let Some(sizes) = self.bytes.get(&key) {
            [cost.scene_bytes, cost.coded_bytes] = sizes.each_ref().map(|sizes| {
                let sizes: Vec<f64> = sizes.iter().map(|bytes| *bytes as f64).collect();
                mean(&sizes).map(|mean| mean.round() as u64)
            });
        }
        cost
    }

    /// Adds the rendered context views of a scene.
    pub(crate) fn add_context_check(&mut self, check: ContextCheck) {
        let sum = self.facts.context_check.get_or_insert_default();
        sum.num_views += check.num_views;
        sum.num_fog += check.num_fog;
    }

    /// Records why a metric is not measured.
    pub fn note_not_measured(&mut self, metric: &str, reason: String) {
        self.facts.not_measured.push(NotMeasured { metric: metric.into(), reason });
    }
}
