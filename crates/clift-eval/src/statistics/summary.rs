//! `summary.json`: the means that a paper prints.
//!
//! A mean is over the views of a scene first and over the scenes then, so that a scene with many
//! targets weighs no more than one with few. The mean over all views stands beside it.

use std::collections::BTreeSet;
use std::path::Path;

use clift_data::{mean, median, p95, replace_file, standard_error};
use clift_model::TokenFormat;
use serde::{Deserialize, Serialize};

use crate::config::method::Method;
use crate::config::token_selection::Selection;
use crate::error::EvalError;
use crate::statistics::eval_results::{EvalResults, NotMeasured, SceneViews};
use crate::statistics::paired::{PairedDifference, differences};
use crate::statistics::pareto::pareto_front;
use crate::statistics::scene_means::{capped, scene_means};
use crate::statistics::view_metrics::{EvalKey, ViewMetrics};

/// Means of a baseline.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Quality {
    /// Mean over scenes of the scene's mean PSNR, in dB.
    pub psnr: Option<f64>,
    /// Mean over scenes of the scene's mean SSIM.
    pub ssim: Option<f64>,
    /// Mean over scenes of the scene's mean LPIPS.
    pub lpips_vgg: Option<f64>,
}

/// The pictures every method must beat.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Baselines {
    /// Copying the nearest context view.
    pub nearest_view: Quality,
    /// Averaging the context views.
    pub mean_image: Quality,
}

/// Means of one setting; `null` is what was not measured.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SummaryPoint {
    /// How its views were made.
    pub variant: Method,
    /// Tokens in the scene file.
    pub num_storage_tokens: usize,
    /// Tokens the renderer was given.
    pub num_render_tokens: usize,
    /// Number format of the stored tokens.
    pub tokens: Option<TokenFormat>,
    /// Views measured in this setting; fewer than of the evaluation only where another system's pictures are missing.
    pub num_views: usize,
    /// Mean over scenes of the scene's mean PSNR, in dB.
    pub psnr: Option<f64>,
    /// Standard error of `psnr` over the scenes; `null` for a single scene.
    pub psnr_stderr: Option<f64>,
    /// Mean PSNR over all views, in dB: differs from `psnr` where scenes have different numbers of views.
    pub psnr_per_view: Option<f64>,
    /// Views whose PSNR is infinite, counted as [`crate::statistics::scene_means::PSNR_CAP_DB`] in the means.
    pub num_identical_views: usize,
    /// Mean over scenes of the scene's mean SSIM.
    pub ssim: Option<f64>,
    /// Mean SSIM over all views.
    pub ssim_per_view: Option<f64>,
    /// Mean over scenes of the scene's mean LPIPS.
    pub lpips_vgg: Option<f64>,
    /// Mean LPIPS over all views.
    pub lpips_vgg_per_view: Option<f64>,
    /// Mean seconds of the renderer per view.
    pub render_s: Option<f64>,
    /// Their median.
    pub render_median_s: Option<f64>,
    /// What 95 % of them do not exceed (nearest rank).
    pub render_p95_s: Option<f64>,
    /// Mean seconds per token selection.
    pub select_s: Option<f64>,
    /// Median seconds per view, selection and renderer together.
    pub frame_median_s: Option<f64>,
    /// What 95 % of them do not exceed.
    pub frame_p95_s: Option<f64>,
    /// Billions of multiply-accumulates per rendered view, attention included.
    pub gflops: Option<f64>,
    /// Bytes of a scene file, or the data size given for another system.
    pub scene_bytes: Option<u64>,
    /// Most resident memory of the whole process while a view was drawn, weights and all; on a CPU alone.
    pub peak_bytes: Option<u64>,
    /// Whether no other point is as good in PSNR for as little time per frame (`frame_median_s`).
    pub pareto_time: bool,
    /// Whether no other point is as good in PSNR for as few bytes (`scene_bytes`).
    pub pareto_bytes: bool,
}

/// Pictures that another system does not have.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Missing {
    /// The system.
    pub variant: Method,
    /// How many target views it has no picture of.
    pub num_missing: usize,
    /// Each of them, inside its folder.
    pub pictures: Vec<String>,
}

/// The content of `summary.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// Scenes with at least one measured view.
    pub num_scenes: usize,
    /// Different target views measured.
    pub num_views: usize,
    /// Scenes left out, each with its reason in the log.
    pub num_skipped: usize,
    /// How the rendered tokens of a view were chosen; `null` where every view is drawn from all stored ones.
    pub selection: Option<Selection>,
    /// SHA-256 of the weights that LPIPS was measured with.
    pub lpips_weights_sha256: Option<String>,
    /// Numbers that are `null` everywhere, and why.
    pub not_measured: Vec<NotMeasured>,
    /// Where another system's pictures were incomplete.
    pub missing: Vec<Missing>,
    /// What the points must beat.
    pub baselines: Baselines,
    /// One per setting, ordered by variant and then by rising token counts.
    pub points: Vec<SummaryPoint>,
    /// What the paper finds better less what it finds worse, scene by scene.
    pub differences: Vec<PairedDifference>,
}

impl Summary {
    /// Averages over the views of each scene first and over the scenes then.
    pub fn new(results: &EvalResults) -> Self {
        let views: BTreeSet<(&str, usize)> = results
            .views()
            .flat_map(|(_, scenes)| scenes)
            .flat_map(|(scene, frames)| frames.keys().map(move |&frame| (scene.as_str(), frame)))
            .collect();
        let scenes: BTreeSet<&str> = views.iter().map(|(scene, _)| *scene).collect();
        let quality = |variant| results.of(EvalKey::baseline(variant)).map(Quality::new).unwrap_or_default();
        let missing = results.missing.iter().map(|(&system, pictures)| Missing {
            variant: Method::System(system),
            num_missing: pictures.len(),
            pictures: pictures.iter().cloned().collect(),
        });
        let mut points: Vec<SummaryPoint> = results
            .views()
            .filter(|(key, _)| !matches!(key.variant, Method::NearestView | Method::MeanImage))
            .map(|(key, views)| SummaryPoint::new(results, key, views))
            .collect();
        mark_fronts(&mut points);
        Self {
            num_scenes: scenes.len(),
            num_views: views.len(),
            num_skipped: results.skipped.len(),
            selection: results.selection,
            lpips_weights_sha256: results.lpips_sha256.clone(),
            not_measured: results.not_measured.clone(),
            missing: missing.collect(),
            baselines: Baselines { nearest_view: quality(Method::NearestView), mean_image: quality(Method::MeanImage) },
            points,
            differences: differences(results),
        }
    }

    /// Writes `summary.json`.
    ///
    /// # Errors
    /// [`EvalError::Io`] when the folder cannot be written.
    pub fn write(&self, path: &Path) -> Result<(), EvalError> {
        serde_json::to_vec_pretty(self)
            .map_err(std::io::Error::from)
            .and_then(|json| replace_file(path, &[&json[..], b"\n"].concat()))
            .map_err(|source| EvalError::Io { action: "writing the summary", source, path: path.to_owned() })
    }
}

impl Quality {
    fn new(views: &SceneViews) -> Self {
        Self {
            psnr: mean(&scene_means(views, |view| Some(capped(view.psnr)))),
            ssim: mean(&scene_means(views, |view| view.ssim)),
            lpips_vgg: mean(&scene_means(views, |view| view.lpips_vgg)),
        }
    }
}

impl SummaryPoint {
    fn new(results: &EvalResults, key: EvalKey, scenes: &SceneViews) -> Self {
        let Quality { psnr, ssim, lpips_vgg } = Quality::new(scenes);
        let views: Vec<&ViewMetrics> = scenes.values().flat_map(|frames| frames.values()).collect();
        let values = |value: fn(&ViewMetrics) -> Option<f64>| -> Vec<f64> {
            views.iter().filter_map(|view| value(view)).collect()
        };
        let statistic = |values: &[f64], statistic: fn(&[f64]) -> f64| (!values.is_empty()).then(|| statistic(values));
        let (render_s, frame_s) = (values(|view| view.render_s), values(ViewMetrics::frame_s));
        let cost = results.cost(key);
        Self {
            variant: key.variant,
            num_storage_tokens: key.num_storage_tokens,
            num_render_tokens: key.num_render_tokens,
            tokens: key.tokens,
            num_views: views.len(),
            psnr,
            psnr_stderr: standard_error(&scene_means(scenes, |view| Some(capped(view.psnr)))),
            psnr_per_view: mean(&values(|view| Some(capped(view.psnr)))),
            num_identical_views: views.iter().filter(|view| view.psnr == f64::INFINITY).count(),
            ssim,
            ssim_per_view: mean(&values(|view| view.ssim)),
            lpips_vgg,
            lpips_vgg_per_view: mean(&values(|view| view.lpips_vgg)),
            render_s: mean(&render_s),
            render_median_s: statistic(&render_s, median),
            render_p95_s: statistic(&render_s, p95),
            select_s: mean(&values(|view| view.select_s)),
            frame_median_s: statistic(&frame_s, median),
            frame_p95_s: statistic(&frame_s, p95),
            gflops: cost.gflops,
            scene_bytes: cost.scene_bytes,
            peak_bytes: cost.peak_bytes,
            pareto_time: false,
            pareto_bytes: false,
        }
    }

    /// Returns the key of the point.
    pub(crate) const fn key(&self) -> EvalKey {
        let Self { variant, num_storage_tokens, num_render_tokens, tokens, .. } = *self;
        EvalKey { variant, num_storage_tokens, num_render_tokens, tokens }
    }
}

fn mark_fronts(points: &mut [SummaryPoint]) {
    let of = |points: &[SummaryPoint], cost: fn(&SummaryPoint) -> Option<f64>| {
        let place = |point: &SummaryPoint| (cost(point).unwrap_or(f64::NAN), point.psnr.unwrap_or(f64::NAN));
        pareto_front(&points.iter().map(place).collect::<Vec<_>>())
    };
    for i in of(points, |point| point.frame_median_s) {
        points[i].pareto_time = true;
    }
    for i in of(points, |point| point.scene_bytes.map(|bytes| bytes as f64)) {
        points[i].pareto_bytes = true;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const KEY: EvalKey = EvalKey {
        variant: Method::Clift,
        num_storage_tokens: 64,
        num_render_tokens: 32,
        tokens: Some(TokenFormat::F16),
    };

    fn results(views: &[(&str, usize, f64)]) -> EvalResults {
        let mut results = EvalResults::default();
        for &(scene, frame, psnr) in views {
            results.add(scene, frame, KEY, ViewMetrics::quality(psnr, Some(psnr / 100.0))).unwrap();
        }
        results
    }

    fn summary(views: &[(&str, usize, f64)]) -> Summary {
        Summary::new(&results(views))
    }

    #[test]
    fn a_scene_with_many_views_weighs_no_more_than_one_with_few() {
        let summary = summary(&[("a", 0, 20.0), ("a", 1, 22.0), ("a", 2, 24.0), ("b", 0, 30.0)]);
        let point = &summary.points[0];
        assert_eq!((point.psnr, point.psnr_per_view), (Some(26.0), Some(24.0)));
        // Scene means 22 and 30: standard deviation sqrt(32), over sqrt(2).
        assert_eq!(point.psnr_stderr, Some(4.0));
        assert_eq!((summary.num_scenes, summary.num_views), (2, 4));
    }

    #[test]
    fn the_standard_error_of_one_scene_is_not_known() {
        assert_eq!(summary(&[("a", 0, 20.0), ("a", 1, 22.0)]).points[0].psnr_stderr, None);
    }

    #[test]
    fn an_identical_picture_counts_as_the_cap_and_is_counted() {
        let point = summary(&[("a", 0, f64::INFINITY), ("b", 0, 20.0)]).points.remove(0);
        assert_eq!((point.psnr, point.num_identical_views), (Some(60.0), 1));
    }

    #[test]
    fn the_summary_does_not_depend_on_the_order_of_the_views() {
        // Sums of these differ in the last bit when they are added in another order.
        let mut views = [("a", 0, 20.1), ("a", 1, 22.7), ("a", 2, 1e-9), ("b", 0, 30.3), ("c", 5, 17.77)];
        let forward = summary(&views);
        views.reverse();
        assert_eq!(summary(&views), forward);
    }

    #[test]
    fn what_was_not_measured_is_null_and_the_file_has_the_documented_names() {
        let mut views = results(&[("a", 0, 20.0)]);
        views.add("a", 0, EvalKey::baseline(Method::NearestView), ViewMetrics::quality(18.0, Some(0.5))).unwrap();
        views.add_gflops(KEY, 2.5);
        views.add_scene_bytes(KEY, 99_000);
        views.set_warm(KEY, Some(1 << 20));
        views.skip("c");
        views.note_not_measured("lpips_vgg", "no weights".into());
        let folder = tempfile::tempdir().unwrap();
        let summary = Summary::new(&views);
        summary.write(&folder.path().join("summary.json")).unwrap();
        let text = std::fs::read_to_string(folder.path().join("summary.json")).unwrap();
        let expected = serde_json::json!({
            "num_scenes": 1, "num_views": 1, "num_skipped": 1,
            "selection": null, "lpips_weights_sha256": null,
            "not_measured": [{"metric": "lpips_vgg", "reason": "no weights"}],
            "missing": [],
            "baselines": {
                "nearest_view": {"psnr": 18.0, "ssim": 0.5, "lpips_vgg": null},
                "mean_image": {"psnr": null, "ssim": null, "lpips_vgg": null}
            },
            "points": [{
                "variant": "clift", "num_storage_tokens": 64, "num_render_tokens": 32, "tokens": "f16",
                "num_views": 1, "psnr": 20.0, "psnr_stderr": null, "psnr_per_view": 20.0, "num_identical_views": 0,
                "ssim": 0.2, "ssim_per_view": 0.2, "lpips_vgg": null, "lpips_vgg_per_view": null,
                "render_s": null, "render_median_s": null, "render_p95_s": null,
                "select_s": null, "frame_median_s": null, "frame_p95_s": null,
                "gflops": 2.5, "scene_bytes": 99_000, "peak_bytes": 1_048_576,
                "pareto_time": false, "pareto_bytes": true
            }],
            "differences": []
        });
        assert_eq!(serde_json::from_str::<serde_json::Value>(&text).unwrap(), expected);
        assert_eq!(serde_json::from_str::<Summary>(&text).unwrap(), summary);
        // Files of earlier versions have a key more.
        let mut former = expected;
        former["adaptive"] = serde_json::json!([]);
        assert_eq!(serde_json::from_value::<Summary>(former).unwrap(), summary);
    }

    #[test]
    fn times_have_a_median_and_a_95th_percentile_alone_and_with_selection() {
        let mut views = EvalResults::default();
        for frame in 0..20 {
            let ms = if frame == 7 { 100.0 } else { 1.0 + frame as f64 };
            let measured =
                ViewMetrics { render_s: Some(ms * 1e-3), select_s: Some(0.5), ..ViewMetrics::quality(20.0, None) };
            views.add("a", frame, KEY, measured).unwrap();
        }
        let point = Summary::new(&views).points.remove(0);
        let near = |got: Option<f64>, expected: f64| (got.unwrap() - expected).abs() < 1e-12;
        // 1 to 20 without 8, and 100: the middle two are 11 and 12, the 19th of 20 is 20.
        assert!(near(point.render_median_s, 0.0115) && near(point.render_p95_s, 0.020), "{point:?}");
        assert!(near(point.frame_median_s, 0.5115) && near(point.frame_p95_s, 0.520), "{point:?}");
        assert!(near(point.select_s, 0.5), "{point:?}");
    }

    #[test]
    fn the_fronts_of_time_and_of_bytes_are_each_marked() {
        let mut views = EvalResults::default();
        // (stored, dB, ms, bytes): the second is slower and worse than the first but smaller than the third.
        for (stored, psnr, ms, bytes) in [(8, 20.0, 1.0, 900), (4, 19.0, 2.0, 400), (16, 22.0, 3.0, 1600)] {
            let key = EvalKey { num_storage_tokens: stored, ..KEY };
            let measured = ViewMetrics { render_s: Some(ms * 1e-3), ..ViewMetrics::quality(psnr, None) };
            views.add("a", 0, key, measured).unwrap();
            views.add_scene_bytes(key, bytes);
        }
        let points = Summary::new(&views).points;
        let marks: Vec<_> = points.iter().map(|p| (p.num_storage_tokens, p.pareto_time, p.pareto_bytes)).collect();
        assert_eq!(marks, [(4, false, true), (8, true, true), (16, true, true)]);
    }
}
