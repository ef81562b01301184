//! `summary.json`: means of quality, time and cost.
//!
//! Means are over the views of a scene, then over the scenes, so every scene has the same weight. Fields `.._per_view` are
//! means over all views.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use clift_core::{mean, median, p95, plural, quartiles, replace_file, standard_error};
use clift_scene::MIN_CONTEXT_PSNR;
use serde::{Deserialize, Serialize};

use crate::config::method::Method;
use crate::config::split::EvalSplit;
use crate::error::EvalError;
use crate::statistics::eval_results::{ContextCheck, EvalResults, Facts, SceneViews};
use crate::statistics::paired::{PairedDifference, differences};
use crate::statistics::pareto::pareto_front;
use crate::statistics::view_metrics::{
    Cost, EvalKey, METRICS, Metric, PSNR, PSNR_CAP_DB, ViewMetrics, best_method, view_mean,
};

/// Means over the views of a scene, then over scenes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Quality {
    pub psnr: Option<f64>,
    pub ssim: Option<f64>,
    pub lpips_vgg: Option<f64>,
    pub sharpness: Option<f64>,
    /// Views whose PSNR is infinite, counted as [`PSNR_CAP_DB`] in the means.
    pub num_identical_views: usize,
}

/// Quality of the baselines, which every method must exceed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Baselines {
    pub nearest_view: Quality,
    pub mean_image: Quality,
}

/// Means of one key; `null` where nothing was measured.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SummaryPoint {
    #[serde(flatten)]
    pub key: EvalKey,
    pub num_views: usize,
    #[serde(flatten)]
    pub quality: Quality,
    /// Standard error of `psnr` over scenes; `null` for a single scene.
    pub psnr_stderr: Option<f64>,
    pub psnr_per_view: Option<f64>,
    pub ssim_per_view: Option<f64>,
    pub lpips_vgg_per_view: Option<f64>,
    pub sharpness_per_view: Option<f64>,
    pub render_s: Option<f64>,
    pub render_median_s: Option<f64>,
    /// 95th percentile, nearest rank.
    pub render_p95_s: Option<f64>,
    pub select_s: Option<f64>,
    /// Time per frame: selection and rendering.
    pub frame_median_s: Option<f64>,
    pub frame_p95_s: Option<f64>,
    /// Half of the frames take between the two.
    pub frame_quartiles_s: Option<[f64; 2]>,
    #[serde(flatten)]
    pub cost: Cost,
    /// Whether no other point has a higher PSNR in a time per frame that is not clearly longer: whose quartiles do not lie
    /// above those of this point.
    pub pareto_time: bool,
    /// Whether no other point is as good in PSNR for as few bytes (`scene_bytes`).
    pub pareto_bytes: bool,
}

/// The content of `summary.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    pub(crate) num_scenes: usize,
    /// Different target views measured.
    pub num_views: usize,
    pub(crate) num_skipped: usize,
    /// Target views that are also contexts: the input holds their images.
    pub(crate) num_context_targets: usize,
    /// Share of the target pixels that masks leave out of the metrics; `null` without masks.
    pub(crate) masked_share: Option<f64>,
    #[serde(flatten)]
    pub(crate) facts: Facts,
    pub(crate) baselines: Baselines,
    /// One point per key, ordered by method and ascending token counts.
    pub points: Vec<SummaryPoint>,
    pub(crate) differences: Vec<PairedDifference>,
}

impl Summary {
    /// Averages the results over the views of each scene, then over the scenes.
    pub fn new(results: &EvalResults) -> Self {
        let views: BTreeSet<(&str, usize)> = results
            .views()
            .flat_map(|(_, scenes)| scenes)
            .flat_map(|(scene, frames)| frames.keys().map(move |&frame| (scene.as_str(), frame)))
            .collect();
        let scenes: BTreeSet<&str> = views.iter().map(|(scene, _)| *scene).collect();
        let quality = |method| results.of(EvalKey::baseline(method)).map(Quality::new).unwrap_or_default();
        let mut points: Vec<SummaryPoint> = results
            .views()
            .filter(|(key, _)| !matches!(key.method, Method::NearestView | Method::MeanImage))
            .map(|(key, views)| SummaryPoint::new(results, key, views))
            .collect();
        mark_fronts(&mut points);
        let masked: f64 = results.masked.values().flat_map(BTreeMap::values).sum();
        Self {
            num_scenes: scenes.len(),
            num_views: views.len(),
            num_skipped: results.skipped.len(),
            num_context_targets: results.context_targets.len(),
            masked_share: (!results.masked.is_empty()).then(|| masked / views.len().max(1) as f64),
            facts: results.facts.clone(),
            baselines: Baselines { nearest_view: quality(Method::NearestView), mean_image: quality(Method::MeanImage) },
            points,
            differences: differences(results),
        }
    }

    pub(crate) fn masked_note(&self) -> Option<String> {
        self.masked_share
            .map(|share| format!("{:.1} % of the target pixels are masked and do not count", 100.0 * share))
    }

    pub(crate) fn warnings(&self) -> impl Iterator<Item = String> {
        let split = self.facts.split.and_then(EvalSplit::warning).map(str::to_owned);
        let split = split.into_iter().chain(training_scenes_note(&self.facts.training_scenes));
        split.chain(context_targets_note(self.num_context_targets)).chain(self.facts.context_check.and_then(fog_note))
    }

    /// Returns the points of the main method in its finest number format.
    pub(crate) fn best_points(&self) -> impl Iterator<Item = &SummaryPoint> {
        let best = best_method(self.points.iter().map(|point| point.key));
        let of_best = self.points.iter().filter(move |point| Some(point.key.method) == best);
        let format = of_best.clone().map(|point| point.key.tokens).min().flatten();
        of_best.filter(move |point| point.key.tokens == format)
    }

    /// Writes `summary.json`.
    pub fn write(&self, path: &Path) -> Result<(), EvalError> {
        serde_json::to_vec_pretty(self)
            .map_err(std::io::Error::from)
            .and_then(|json| replace_file(path, &[&json[..], b"\n"].concat()))
            .map_err(EvalError::io("writing the summary", path))
    }
}

/// Returns the warning about measured scenes that the models were trained on; `None` for no such scene.
pub fn training_scenes_note(scenes: &BTreeSet<String>) -> Option<String> {
    let first = scenes.first()?;
    Some(format!(
        "the evaluation shares {} with training, such as {first}: the results are not of held-out scenes",
        plural(scenes.len(), "scene"),
    ))
}

/// Returns the note on targets that are also contexts; `None` for no such target.
pub(crate) fn context_targets_note(num_given: usize) -> Option<String> {
    (num_given > 0).then(|| {
        let targets = if num_given == 1 { "target is also a context" } else { "targets are also contexts" };
        format!(
            "{num_given} {targets}: nearest_view copies such an image and scores {PSNR_CAP_DB} dB; leave them out with \
             --drop-context-targets"
        )
    })
}

/// Returns the warning about context views that come out as fog; `None` for no such view.
fn fog_note(ContextCheck { num_views, num_fog }: ContextCheck) -> Option<String> {
    (num_fog > 0).then(|| {
        format!(
            "{num_fog} of {num_views} context views, rendered from all tokens, are below {MIN_CONTEXT_PSNR} dB or worse than \
             the mean image, as fog: the contexts of a scene are too far apart for the model; choose nearer ones with \
             --index, or train on the data set (configs/capture.toml)"
        )
    })
}

/// Returns the mean over the views of each scene, for the scenes that have a value.
fn scene_means(views: &SceneViews, metric: Metric) -> Vec<f64> {
    views.values().filter_map(|frames| view_mean(frames, metric)).collect()
}

impl Quality {
    fn new(views: &SceneViews) -> Self {
        let [psnr, ssim, lpips_vgg, sharpness] = METRICS.map(|metric| mean(&scene_means(views, metric)));
        let num_identical_views =
            views.values().flat_map(BTreeMap::values).filter(|view| view.psnr == f64::INFINITY).count();
        Self { psnr, ssim, lpips_vgg, sharpness, num_identical_views }
    }
}

impl SummaryPoint {
    fn new(results: &EvalResults, key: EvalKey, scenes: &SceneViews) -> Self {
        let views: Vec<&ViewMetrics> = scenes.values().flat_map(|frames| frames.values()).collect();
        let per_view = |metric: Metric| mean(&views.iter().filter_map(|view| metric(view)).collect::<Vec<_>>());
        let [psnr_per_view, ssim_per_view, lpips_vgg_per_view, sharpness_per_view] = METRICS.map(per_view);
        let statistic = |values: &[f64], statistic: fn(&[f64]) -> f64| (!values.is_empty()).then(|| statistic(values));
        let (render_s, select_s, frame_s) = timed(results, key);
        Self {
            key,
            num_views: views.len(),
            quality: Quality::new(scenes),
            psnr_stderr: standard_error(&scene_means(scenes, PSNR)),
            psnr_per_view,
            ssim_per_view,
            lpips_vgg_per_view,
            sharpness_per_view,
            render_s: mean(&render_s),
            render_median_s: statistic(&render_s, median),
            render_p95_s: statistic(&render_s, p95),
            select_s: mean(&select_s),
            frame_median_s: statistic(&frame_s, median),
            frame_p95_s: statistic(&frame_s, p95),
            frame_quartiles_s: quartiles(&frame_s),
            cost: results.cost(key),
            pareto_time: false,
            pareto_bytes: false,
        }
    }
}

/// Returns the times of rendering, of token selection and of both, of all views that are the same computation as those of
/// `key`: methods and number formats with equal token counts differ in the values of their tokens only, but for those of
/// another network.
fn timed(results: &EvalResults, key: EvalKey) -> (Vec<f64>, Vec<f64>, Vec<f64>) {
    let is_same = |other: EvalKey| {
        let has_same_selection =
            other.is_whole() && key.is_whole() || other.num_storage_tokens == key.num_storage_tokens;
        let has_same_network = other.method.network() == key.method.network();
        let has_same_count = other.num_render_tokens == key.num_render_tokens && other.num_render_tokens > 0;
        has_same_network && has_same_count && has_same_selection
    };
    let views = results.views().filter(|(other, _)| is_same(*other)).flat_map(|(_, scenes)| scenes.values());
    let views: Vec<&ViewMetrics> = views.flat_map(BTreeMap::values).collect();
    let values = |metric: Metric| views.iter().filter_map(|view| metric(view)).collect();
    (values(|view| view.render_s), values(|view| view.select_s), values(ViewMetrics::frame_s))
}

fn mark_fronts(points: &mut [SummaryPoint]) {
    let of = |points: &[SummaryPoint], cost: fn(&SummaryPoint) -> Option<[f64; 2]>| {
        let position =
            |point: &SummaryPoint| (cost(point).unwrap_or([f64::NAN; 2]), point.quality.psnr.unwrap_or(f64::NAN));
        pareto_front(&points.iter().map(position).collect::<Vec<_>>())
    };
    for i in of(points, |point| point.frame_quartiles_s) {
        points[i].pareto_time = true;
    }
    for i in of(points, |point| point.cost.scene_bytes.map(|bytes| [bytes as f64; 2])) {
        points[i].pareto_bytes = true;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clift_scene::TokenCoding;

    use crate::testing::CLIFT;

    fn results(views: &[(&str, usize, f64)]) -> EvalResults {
        let mut results = EvalResults::default();
        for &(scene, frame, psnr) in views {
            results.add(scene, frame, CLIFT, ViewMetrics::quality(psnr, Some(psnr / 100.0)));
        }
        results
    }

    #[test]
    fn means_weigh_scenes_equally_and_cap_psnr() {
        for (views, psnr, psnr_per_view, psnr_stderr, num_identical) in [
            // Scene means 22 and 30: standard deviation sqrt(32), over sqrt(2).
            (&[("a", 0, 20.0), ("a", 1, 22.0), ("a", 2, 24.0), ("b", 0, 30.0)][..], 26.0, 24.0, Some(4.0), 0),
            (&[("a", 0, 20.0), ("a", 1, 22.0)], 21.0, 21.0, None, 0),
            (&[("a", 0, f64::INFINITY), ("b", 0, 20.0)], 60.0, 60.0, Some(40.0), 1),
        ] {
            let point = Summary::new(&results(views)).points.remove(0);
            assert_eq!((point.quality.psnr, point.psnr_per_view), (Some(psnr), Some(psnr_per_view)));
            assert_eq!((point.psnr_stderr, point.quality.num_identical_views), (psnr_stderr, num_identical));
        }
        // Sums of these values depend on their order in the last bit.
        let mut views = [("a", 0, 20.1), ("a", 1, 22.7), ("a", 2, 1e-9), ("b", 0, 30.3), ("c", 5, 17.77)];
        let forward = Summary::new(&results(&views));
        views.reverse();
        assert_eq!(Summary::new(&results(&views)), forward);
    }

    #[test]
    fn the_file_has_the_documented_names() {
        let mut views = EvalResults::default();
        let measured = ViewMetrics { sharpness: Some(0.75), ..ViewMetrics::quality(20.0, Some(0.2)) };
        views.add("a", 0, CLIFT, measured);
        let copy = ViewMetrics::quality(f64::INFINITY, Some(1.0));
        views.add("a", 0, EvalKey::baseline(Method::NearestView), copy);
        views.facts.split = Some(EvalSplit::HeldOutFrames);
        views.context_targets.insert(("a".into(), 0));
        views.facts.context_frames.insert("a".into(), vec![0, 4]);
        views.add_context_check(ContextCheck { num_views: 2, num_fog: 1 });
        views.facts.training_scenes.insert("a".into());
        views.masked.insert("a".into(), [(0, 0.25)].into());
        let cost = Cost { gflops: Some(2.5), scene_values: Some(4096), scene_bytes: Some(99_000), ..Cost::default() };
        views.costs.insert(CLIFT, cost);
        views.skipped.insert("c".into());
        views.note_not_measured("lpips_vgg", "no weights".into());
        let folder = tempfile::tempdir().unwrap();
        let summary = Summary::new(&views);
        summary.write(&folder.path().join("summary.json")).unwrap();
        let text = std::fs::read_to_string(folder.path().join("summary.json")).unwrap();
        let point = serde_json::json!({
            "method": "clift", "num_storage_tokens": 64, "num_render_tokens": 32, "tokens": "f16",
            "num_views": 1, "psnr": 20.0, "psnr_stderr": null, "psnr_per_view": 20.0, "num_identical_views": 0,
            "ssim": 0.2, "ssim_per_view": 0.2, "lpips_vgg": null, "lpips_vgg_per_view": null,
            "sharpness": 0.75, "sharpness_per_view": 0.75,
            "render_s": null, "render_median_s": null, "render_p95_s": null,
            "select_s": null, "frame_median_s": null, "frame_p95_s": null, "frame_quartiles_s": null,
            "gflops": 2.5, "scene_values": 4096, "scene_bytes": 99_000, "coded_bytes": null, "peak_bytes": null,
            "pareto_time": false, "pareto_bytes": true
        });
        let expected = serde_json::json!({
            "num_scenes": 1, "num_views": 1, "num_skipped": 1, "split": "held_out_frames", "num_context_targets": 1,
            "context_frames": {"a": [0, 4]}, "context_check": {"num_views": 2, "num_fog": 1},
            "training_scenes": ["a"],
            "masked_share": 0.25,
            "selection": null, "lpips_weights_sha256": null,
            "not_measured": [{"metric": "lpips_vgg", "reason": "no weights"}],
            "baselines": {
                "nearest_view": {"psnr": 100.0, "ssim": 1.0, "lpips_vgg": null, "sharpness": null, "num_identical_views": 1},
                "mean_image": {"psnr": null, "ssim": null, "lpips_vgg": null, "sharpness": null, "num_identical_views": 0}
            },
            "points": [point],
            "differences": []
        });
        assert_eq!(serde_json::from_str::<serde_json::Value>(&text).unwrap(), expected);
        assert_eq!(serde_json::from_str::<Summary>(&text).unwrap(), summary);
        let warnings = summary.warnings().collect::<Vec<_>>().join("\n");
        assert!(warnings.contains("1 of 2 context views, rendered from all tokens, are below 23 dB"), "{warnings}");
    }

    #[test]
    fn equal_computations_share_their_times() {
        let mut views = EvalResults::default();
        let timed = |ms: f64, psnr| ViewMetrics { render_s: Some(ms * 1e-3), ..ViewMetrics::quality(psnr, None) };
        let [f32, f16] = [TokenCoding::F32, TokenCoding::F16].map(|tokens| EvalKey { tokens: Some(tokens), ..CLIFT });
        let random = EvalKey { method: Method::Random, ..f16 };
        let all = EvalKey { num_storage_tokens: 32, ..f16 };
        let lvsm = EvalKey { method: Method::Whole(clift_model::Architecture::LvsmEd), ..f16 };
        for frame in 0..8 {
            // Noise of the machine alone: the one with the lowest PSNR happens to be the fastest.
            let ms = 10.0 + frame as f64;
            for (key, ms, psnr) in [(f32, ms, 22.0), (f16, ms - 0.5, 21.0), (random, ms - 0.9, 20.0), (all, 2.0, 19.0)]
            {
                views.add("a", frame, key, timed(ms, psnr));
            }
            views.add("a", frame, lvsm, timed(40.0, 18.0));
        }
        let timed = |frame: usize| {
            let ms = if frame == 7 { 100.0 } else { 1.0 + frame as f64 };
            ViewMetrics { render_s: Some(ms * 1e-3), select_s: Some(0.5), ..ViewMetrics::quality(20.0, None) }
        };
        let selected = EvalKey { num_storage_tokens: 50, num_render_tokens: 7, ..f16 };
        (0..20).for_each(|frame| assert!(views.add("a", frame, selected, timed(frame))));
        let points = Summary::new(&views).points;
        let of = |key| points.iter().find(|point| point.key == key).unwrap();
        assert_eq!(of(f32).frame_median_s, of(random).frame_median_s);
        assert_eq!(of(f32).frame_quartiles_s, of(f16).frame_quartiles_s);
        assert_eq!(of(all).frame_quartiles_s, Some([0.002; 2]), "another computation: no selection");
        assert_eq!(of(lvsm).frame_quartiles_s, Some([0.04; 2]), "another network of as many tokens");
        assert_eq!([f32, f16, random, all].map(|key| of(key).pareto_time), [true, false, false, true]);
        // 1 to 20 without 8, and 100: the middle two are 11 and 12, the 19th of 20 is 20.
        let point = of(selected);
        let near = |got: Option<f64>, expected: f64| (got.unwrap() - expected).abs() < 1e-12;
        assert!(near(point.render_median_s, 0.0115) && near(point.render_p95_s, 0.020), "{point:?}");
        assert!(near(point.frame_median_s, 0.5115) && near(point.frame_p95_s, 0.520), "{point:?}");
        assert!(near(point.select_s, 0.5), "{point:?}");
    }
}
