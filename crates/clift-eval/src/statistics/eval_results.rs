//! The metrics of every view, and `views.csv`.

use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use clift_data::replace_file;
use serde::{Deserialize, Serialize};

use crate::config::method::MethodName;
use crate::config::token_selection::Selection;
use crate::error::EvalError;
use crate::statistics::view_metrics::{Cost, EvalKey, ViewMetrics};

/// Something that a summary has no number of.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct NotMeasured {
    /// Name of the number.
    pub metric: String,
    /// Why, and what to do about it.
    pub reason: String,
}

/// The views of one key, by scene and target frame.
pub type SceneViews = BTreeMap<String, BTreeMap<usize, ViewMetrics>>;

/// The results of an evaluation. Views are added in any order: files depend on the set of views alone.
#[derive(Clone, Debug, Default)]
pub struct EvalResults {
    views: BTreeMap<EvalKey, SceneViews>,
    costs: BTreeMap<EvalKey, Cost>,
    warm: BTreeSet<EvalKey>,
    pub(crate) skipped: BTreeSet<String>,
    pub(crate) not_measured: Vec<NotMeasured>,
    pub(crate) missing: BTreeMap<MethodName, BTreeSet<String>>,
    pub(crate) lpips_sha256: Option<String>,
    /// How rendered tokens were selected; `None` where every view was rendered from all stored tokens.
    pub(crate) selection: Option<Selection>,
}

impl EvalResults {
    /// Adds one view of a scene.
    ///
    /// # Errors
    /// [`EvalError::DuplicateView`] when the results already hold the view under this key.
    pub fn add(&mut self, scene: &str, frame: usize, key: EvalKey, view: ViewMetrics) -> Result<(), EvalError> {
        let scenes = self.views.entry(key).or_default();
        match scenes.entry(scene.to_owned()).or_default().entry(frame) {
            Entry::Vacant(entry) => {
                entry.insert(view);
                Ok(())
            }
            Entry::Occupied(_) => {
                let EvalKey { variant, num_storage_tokens: stored, num_render_tokens: rendered, .. } = key;
                let variant = variant.name();
                let view = format!("{variant} of {scene}, frame {frame}, {stored} stored, {rendered} rendered");
                Err(EvalError::DuplicateView { view })
            }
        }
    }

    /// Returns whether a view has been added.
    pub fn contains(&self, scene: &str, frame: usize, key: EvalKey) -> bool {
        self.of(key).and_then(|scenes| scenes.get(scene)).is_some_and(|frames| frames.contains_key(&frame))
    }

    /// Iterates over the views of every key, in the order of keys.
    pub fn views(&self) -> impl Iterator<Item = (EvalKey, &SceneViews)> {
        self.views.iter().map(|(key, views)| (*key, views))
    }

    /// Returns the views of one key.
    pub fn of(&self, key: EvalKey) -> Option<&SceneViews> {
        self.views.get(&key)
    }

    /// Returns the cost of one key.
    pub fn cost(&self, key: EvalKey) -> Cost {
        self.costs.get(&key).copied().unwrap_or_default()
    }

    /// Records the size of a scene file; of scenes with different numbers of context views the largest counts.
    pub fn add_scene_bytes(&mut self, key: EvalKey, bytes: u64) {
        let cost = self.costs.entry(key).or_default();
        cost.scene_bytes = cost.scene_bytes.max(Some(bytes));
    }

    /// Records the multiply-accumulates of rendering a view, in billions.
    pub fn add_gflops(&mut self, key: EvalKey, gflops: f64) {
        self.costs.entry(key).or_default().gflops = Some(gflops);
    }

    /// Returns whether a warm-up view of a key has been rendered.
    pub(crate) fn is_warm(&self, key: EvalKey) -> bool {
        self.warm.contains(&key)
    }

    /// Records the warm-up view of a key, with its peak memory.
    pub(crate) fn set_warm(&mut self, key: EvalKey, peak_bytes: Option<u64>) {
        self.warm.insert(key);
        self.costs.entry(key).or_default().peak_bytes = peak_bytes;
    }

    /// Records why a metric is not measured.
    pub fn note_not_measured(&mut self, metric: &str, reason: String) {
        self.not_measured.push(NotMeasured { metric: metric.into(), reason });
    }

    /// Records the weights of LPIPS.
    pub fn set_lpips_weights(&mut self, sha256: &str) {
        self.lpips_sha256 = Some(sha256.into());
    }

    /// Records an image that another system does not have.
    pub fn miss(&mut self, system: MethodName, picture: String) {
        self.missing.entry(system).or_default().insert(picture);
    }

    /// Records a skipped scene.
    pub fn skip(&mut self, scene: &str) {
        self.skipped.insert(scene.to_owned());
    }

    /// Writes `views.csv`: a row per key and view, baselines included; an empty field was not measured,
    /// and an identical image has the PSNR `inf`.
    ///
    /// # Errors
    /// [`EvalError::Io`] when the folder cannot be written.
    pub fn write_views(&self, path: &Path) -> Result<(), EvalError> {
        let failed = |source| EvalError::Io { action: "writing the measured views", source, path: path.to_owned() };
        let text = |value: Option<f64>| value.map(|value| value.to_string()).unwrap_or_default();
        let mut csv = csv::Writer::from_writer(Vec::new());
        let mut write = |row: [&str; 11]| csv.write_record(row).map_err(|error| failed(error.into()));
        write(VIEW_COLUMNS)?;
        for (key, scenes) in &self.views {
            let (stored, rendered) = (key.num_storage_tokens.to_string(), key.num_render_tokens.to_string());
            let views = scenes.iter().flat_map(|(scene, frames)| frames.iter().map(move |view| (scene, view)));
            for (scene, (frame, view)) in views {
                write([
                    scene,
                    &frame.to_string(),
                    key.variant.name(),
                    &stored,
                    &rendered,
                    &view.psnr.to_string(),
                    &text(view.ssim),
                    &text(view.lpips_vgg),
                    &text(view.render_s),
                    &text(view.select_s),
                    key.format_name(),
                ])?;
            }
        }
        let content = csv.into_inner().map_err(|error| failed(error.into_error()))?;
        replace_file(path, &content).map_err(failed)
    }
}

/// Columns of `views.csv`.
const VIEW_COLUMNS: [&str; 11] = [
    "scene",
    "target_frame",
    "variant",
    "num_storage_tokens",
    "num_render_tokens",
    "psnr",
    "ssim",
    "lpips_vgg",
    "render_s",
    "select_s",
    "tokens",
];

#[cfg(test)]
mod tests {
    use clift_model::TokenFormat;

    use super::*;
    use crate::config::method::Method;

    const CLIFT: EvalKey = EvalKey {
        variant: Method::Clift,
        num_storage_tokens: 64,
        num_render_tokens: 32,
        tokens: Some(TokenFormat::F16),
    };

    #[test]
    fn views_csv_has_a_row_per_view_in_a_fixed_order_whatever_came_first() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("views.csv");
        let measured = ViewMetrics { render_s: Some(0.5), ..ViewMetrics::quality(20.25, Some(0.5)) };
        let rows = [
            ("room, \"big\"", 3, CLIFT, measured),
            ("attic", 9, CLIFT, measured),
            ("attic", 9, EvalKey::baseline(Method::NearestView), ViewMetrics::quality(f64::INFINITY, None)),
        ];
        let expected =
            "scene,target_frame,variant,num_storage_tokens,num_render_tokens,psnr,ssim,lpips_vgg,render_s,select_s,tokens
attic,9,clift,64,32,20.25,0.5,,0.5,,f16
\"room, \"\"big\"\"\",3,clift,64,32,20.25,0.5,,0.5,,f16
attic,9,nearest_view,0,0,inf,,,,,
";
        for order in [[0, 1, 2], [2, 1, 0]] {
            let mut views = EvalResults::default();
            for (scene, frame, key, view) in order.map(|i| rows[i]) {
                views.add(scene, frame, key, view).unwrap();
            }
            views.write_views(&path).unwrap();
            assert_eq!(std::fs::read_to_string(&path).unwrap(), expected);
        }
    }

    #[test]
    fn a_view_counts_once() {
        let mut views = EvalResults::default();
        views.add("attic", 9, CLIFT, ViewMetrics::quality(20.0, None)).unwrap();
        let message = views.add("attic", 9, CLIFT, ViewMetrics::quality(30.0, None)).unwrap_err().to_string();
        assert_eq!(message, "clift of attic, frame 9, 64 stored, 32 rendered was already measured: a view counts once");
        assert_eq!(views.of(CLIFT).unwrap()["attic"][&9].psnr, 20.0);
    }
}
