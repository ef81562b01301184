//! The metrics of every view of an evaluation.

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};

use crate::config::method::Method;
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

/// The views of one key, by scene and target frame.
pub type SceneViews = BTreeMap<String, BTreeMap<usize, ViewMetrics>>;

/// The results of an evaluation. Output files do not depend on the order in which views are added.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct EvalResults {
    views: BTreeMap<EvalKey, SceneViews>,
    /// Cost of every key of which a warm-up view was rendered, and of external methods.
    pub(crate) costs: BTreeMap<EvalKey, Cost>,
    /// Sizes of the scene files of every key.
    scene_bytes: BTreeMap<EvalKey, Vec<u64>>,
    /// Sizes of the scene files with the default coding.
    coded_bytes: BTreeMap<EvalKey, Vec<u64>>,
    pub(crate) skipped: BTreeSet<String>,
    pub(crate) not_measured: Vec<NotMeasured>,
    pub(crate) missing: BTreeMap<Method, BTreeSet<String>>,
    pub(crate) lpips_sha256: Option<String>,
    /// How rendered tokens were selected; `None` where every view was rendered from all stored tokens.
    pub(crate) selection: Option<Selection>,
    /// Origin of the views; `None` if unknown.
    pub(crate) split: Option<EvalSplit>,
    /// Scene and frame of the targets that are also contexts.
    pub(crate) context_targets: BTreeSet<(String, usize)>,
    /// Context frames of every measured scene.
    pub(crate) context_frames: BTreeMap<String, Vec<usize>>,
    /// The rendered context views of all scenes; `None` without [`Sweep::checks_contexts`](crate::Sweep::checks_contexts).
    pub(crate) context_check: Option<ContextCheck>,
    /// Keys of the scenes that the models were trained on.
    pub(crate) training_scenes: BTreeSet<String>,
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
        let frames = self.context_frames.get(scene)?;
        Some(frames.iter().map(ToString::to_string).collect::<Vec<_>>().join(" "))
    }

    /// Adds the views that another process has measured of other scenes.
    pub(crate) fn merge(&mut self, other: Self) {
        for (key, scenes) in other.views {
            for (scene, frames) in scenes {
                for (frame, view) in frames {
                    self.add(&scene, frame, key, view);
                }
            }
        }
        for (key, cost) in other.costs {
            self.costs.entry(key).or_insert(cost);
        }
        for (key, sizes) in other.scene_bytes {
            for bytes in sizes {
                self.add_scene_bytes(key, bytes);
            }
        }
        for (key, sizes) in other.coded_bytes {
            for bytes in sizes {
                self.add_coded_bytes(key, bytes);
            }
        }
        for (method, images) in other.missing {
            self.missing.entry(method).or_default().extend(images);
        }
        self.skipped.extend(other.skipped);
        self.not_measured.extend(other.not_measured);
        self.selection = self.selection.or(other.selection);
        self.context_targets.extend(other.context_targets);
        self.context_frames.extend(other.context_frames);
        if let Some(check) = other.context_check {
            self.add_context_check(check);
        }
        self.masked.extend(other.masked);
    }

    /// Iterates over the views of every key, in the order of keys.
    pub fn views(&self) -> impl Iterator<Item = (EvalKey, &SceneViews)> {
        self.views.iter().map(|(key, views)| (*key, views))
    }

    /// Returns the views of one key.
    pub fn of(&self, key: EvalKey) -> Option<&SceneViews> {
        self.views.get(&key)
    }

    /// Records the size of a scene file. The cost of a key has the mean over scenes.
    pub fn add_scene_bytes(&mut self, key: EvalKey, bytes: u64) {
        let sizes = self.scene_bytes.entry(key).or_default();
        sizes.push(bytes);
        self.costs.entry(key).or_default().scene_bytes = Some(mean(sizes));
    }

    /// Records the size of a scene file with the default coding. The cost of a key has the mean over scenes.
    pub(crate) fn add_coded_bytes(&mut self, key: EvalKey, bytes: u64) {
        let sizes = self.coded_bytes.entry(key).or_default();
        sizes.push(bytes);
        self.costs.entry(key).or_default().coded_bytes = Some(mean(sizes));
    }

    /// Adds the rendered context views of a scene.
    pub(crate) fn add_context_check(&mut self, check: ContextCheck) {
        let sum = self.context_check.get_or_insert_default();
        sum.num_views += check.num_views;
        sum.num_fog += check.num_fog;
    }

    /// Records why a metric is not measured.
    pub fn note_not_measured(&mut self, metric: &str, reason: String) {
        self.not_measured.push(NotMeasured { metric: metric.into(), reason });
    }

    /// Records an image that an external method does not have.
    pub fn record_missing_image(&mut self, method: Method, image: String) {
        self.missing.entry(method).or_default().insert(image);
    }
}

fn mean(sizes: &[u64]) -> u64 {
    (sizes.iter().sum::<u64>() as f64 / sizes.len() as f64).round() as u64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::CLIFT;

    #[test]
    fn parts_of_several_processes_are_merged() {
        let part = |scene: &str, bytes| {
            let mut part = EvalResults::default();
            part.add(scene, 1, CLIFT, ViewMetrics::quality(f64::INFINITY, None));
            part.add_scene_bytes(CLIFT, bytes);
            part.context_frames.insert(scene.into(), vec![0, 2]);
            part.add_context_check(ContextCheck { num_views: 2, num_fog: 1 });
            part
        };
        let mut whole = part("attic", 10);
        whole.merge(part("cellar", 20));
        assert_eq!(whole.of(CLIFT).unwrap().len(), 2);
        assert_eq!(whole.costs[&CLIFT].scene_bytes, Some(15));
        assert_eq!(whole.context_frames.len(), 2);
        assert_eq!(whole.context_check, Some(ContextCheck { num_views: 4, num_fog: 2 }));
    }

    #[test]
    fn a_view_counts_once() {
        let mut views = EvalResults::default();
        views.add("attic", 9, CLIFT, ViewMetrics::quality(20.0, None));
        views.add("attic", 9, CLIFT, ViewMetrics::quality(30.0, None));
        assert_eq!(views.of(CLIFT).unwrap()["attic"][&9].psnr, 20.0);
    }
}
