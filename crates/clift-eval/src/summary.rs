//! `summary.json`: the means that a paper prints.
//!
//! A mean is over the views of a scene first and over the scenes then, so that a scene with many
//! targets weighs no more than one with few. The mean over all views stands beside it.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::path::Path;

use clift_data::files::replace;
use serde::{Deserialize, Serialize};

use crate::adaptive::Adaptive;
use crate::error::EvalError;
use crate::measured::{Accumulator, Measured, Setting, Variant, ViewsOfSetting};
use crate::paired::Difference;

/// What an identical picture counts as in a mean, in dB; larger values are counted as this too.
///
/// Its PSNR is infinite, which no mean survives and JSON cannot hold. 100 dB is what one wrong 8-bit
/// level in one of the values of a 256 x 256 picture gives (101 dB), so nothing real is cut off.
/// Leaving such views out instead would lower the mean of the method that got them right.
pub const PSNR_CAP_DB: f64 = 100.0;

/// Means of a baseline.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Quality {
    /// Mean over scenes of the scene's mean PSNR, in dB.
    pub psnr: Option<f64>,
    /// Mean over scenes of the scene's mean SSIM.
    pub ssim: Option<f64>,
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
pub struct Point {
    /// How its views were made.
    pub variant: Variant,
    /// Tokens in the scene file.
    pub num_storage_tokens: usize,
    /// Tokens the renderer was given.
    pub num_render_tokens: usize,
    /// Mean over scenes of the scene's mean PSNR, in dB.
    pub psnr: Option<f64>,
    /// Standard error of `psnr` over the scenes; `null` for a single scene.
    pub psnr_stderr: Option<f64>,
    /// Mean PSNR over all views, in dB: differs from `psnr` where scenes have different numbers of views.
    pub psnr_per_view: Option<f64>,
    /// Views whose PSNR is infinite, counted as [`PSNR_CAP_DB`] in the means.
    pub num_identical_views: usize,
    /// Mean over scenes of the scene's mean SSIM.
    pub ssim: Option<f64>,
    /// Mean over scenes of the scene's mean LPIPS.
    pub lpips_vgg: Option<f64>,
    /// Mean seconds per rendered view.
    pub render_s: Option<f64>,
    /// Mean seconds per token selection.
    pub select_s: Option<f64>,
    /// Billions of multiply-accumulates per rendered view, attention included.
    pub gflops: Option<f64>,
    /// Bytes of a scene file.
    pub scene_bytes: Option<u64>,
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
    /// What the points must beat.
    pub baselines: Baselines,
    /// One per setting, ordered by variant and then by rising token counts.
    pub points: Vec<Point>,
    /// What the paper finds better less what it finds worse, scene by scene.
    pub differences: Vec<Difference>,
    /// A count for every scene against one for all.
    pub adaptive: Vec<Adaptive>,
}

impl Accumulator {
    /// Averages over each scene's views, and over the scenes then.
    pub fn summary(&self) -> Summary {
        let targets: BTreeSet<_> = self.views.values().flat_map(BTreeMap::keys).collect();
        let scenes: BTreeSet<_> = targets.iter().map(|(scene, _)| scene).collect();
        let quality = |variant| {
            let views = self.views.get(&Setting::baseline(variant));
            Quality {
                psnr: views.and_then(|views| mean(&scene_means(views, |view| Some(capped(view.psnr))))),
                ssim: views.and_then(|views| mean(&scene_means(views, |view| view.ssim))),
            }
        };
        Summary {
            num_scenes: scenes.len(),
            num_views: targets.len(),
            num_skipped: self.skipped.len(),
            baselines: Baselines {
                nearest_view: quality(Variant::NearestView),
                mean_image: quality(Variant::MeanImage),
            },
            points: self
                .views
                .iter()
                .filter(|(setting, _)| !matches!(setting.variant, Variant::NearestView | Variant::MeanImage))
                .map(|(setting, views)| self.point(*setting, views))
                .collect(),
            differences: self.differences(),
            adaptive: self.adaptive(),
        }
    }

    fn point(&self, setting: Setting, views: &ViewsOfSetting) -> Point {
        let per_scene = scene_means(views, |view| Some(capped(view.psnr)));
        let over_scenes = |value: fn(&Measured) -> Option<f64>| mean(&scene_means(views, value));
        let over_views =
            |value: fn(&Measured) -> Option<f64>| mean(&views.values().filter_map(value).collect::<Vec<_>>());
        let cost = self.costs.get(&setting).copied().unwrap_or_default();
        Point {
            variant: setting.variant,
            num_storage_tokens: setting.num_storage_tokens,
            num_render_tokens: setting.num_render_tokens,
            psnr: mean(&per_scene),
            psnr_stderr: standard_error(&per_scene),
            psnr_per_view: over_views(|view| Some(capped(view.psnr))),
            num_identical_views: views.values().filter(|view| view.psnr == f64::INFINITY).count(),
            ssim: over_scenes(|view| view.ssim),
            lpips_vgg: over_scenes(|view| view.lpips_vgg),
            render_s: over_views(|view| view.render_s),
            select_s: over_views(|view| view.select_s),
            gflops: cost.gflops,
            scene_bytes: cost.scene_bytes,
        }
    }
}

impl Summary {
    /// Writes `summary.json`.
    ///
    /// # Errors
    /// [`EvalError::Io`] when the folder cannot be written.
    pub fn write(&self, path: &Path) -> Result<(), EvalError> {
        serde_json::to_vec_pretty(self)
            .map_err(std::io::Error::from)
            .and_then(|json| replace(path, &[&json[..], b"\n"].concat()))
            .map_err(|source| EvalError::Io { action: "writing the summary", source, path: path.to_owned() })
    }
}

/// A table for people: quality, tokens and cost of each setting; `-` is what was not measured.
impl fmt::Display for Summary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { num_scenes, num_views, num_skipped, baselines, points, differences, adaptive } = self;
        writeln!(f, "{num_views} views of {num_scenes} scenes, {num_skipped} scenes left out\n")?;
        let headers =
            ["stored", "rendered", "PSNR dB", "+- dB", "SSIM", "LPIPS", "select ms", "render ms", "GMAC", "scene kB"];
        write_row(f, "variant", headers.map(str::to_owned))?;
        for (variant, Quality { psnr, ssim }) in
            [(Variant::NearestView, baselines.nearest_view), (Variant::MeanImage, baselines.mean_image)]
        {
            let mut cells = std::array::from_fn(|_| cell(None, 0));
            (cells[2], cells[4]) = (cell(psnr, 2), cell(ssim, 3));
            write_row(f, variant.name(), cells)?;
        }
        for point in points {
            let cells = [
                point.num_storage_tokens.to_string(),
                point.num_render_tokens.to_string(),
                cell(point.psnr, 2),
                cell(point.psnr_stderr, 2),
                cell(point.ssim, 3),
                cell(point.lpips_vgg, 3),
                cell(point.select_s.map(|seconds| seconds * 1e3), 1),
                cell(point.render_s.map(|seconds| seconds * 1e3), 1),
                cell(point.gflops, 1),
                cell(point.scene_bytes.map(|bytes| bytes as f64 / 1e3), 1),
            ];
            write_row(f, point.variant.name(), cells)?;
        }
        if !differences.is_empty() {
            writeln!(f, "\nPSNR of the same scenes, difference and standard error")?;
        }
        for Difference { variant, against, num_storage_tokens, psnr, psnr_stderr, .. } in differences {
            let error = cell(*psnr_stderr, 2);
            let names = format!("{} - {}", variant.name(), against.name());
            writeln!(f, "{names:<24} {num_storage_tokens:>6} tokens {psnr:>+7.2} +- {error} dB")?;
        }
        if !adaptive.is_empty() {
            writeln!(f, "\n--max-error against one count for all scenes, at no more tokens on average")?;
        }
        for Adaptive { max_error, mean_storage_tokens: own, num_storage_tokens: fixed, difference, .. } in adaptive {
            writeln!(f, "{max_error:<8.4} {own:>8.1} tokens against {fixed:>6} {difference:>+7.2} dB")?;
        }
        Ok(())
    }
}

fn cell(value: Option<f64>, decimals: usize) -> String {
    value.map_or_else(|| "-".to_owned(), |value| format!("{value:.decimals$}"))
}

fn write_row(f: &mut fmt::Formatter<'_>, name: &str, cells: [String; 10]) -> fmt::Result {
    const WIDTHS: [usize; 10] = [7, 9, 8, 6, 6, 6, 10, 10, 8, 9];
    write!(f, "{name:<12}")?;
    for (cell, width) in cells.iter().zip(WIDTHS) {
        write!(f, " {cell:>width$}")?;
    }
    writeln!(f)
}

pub(crate) fn capped(psnr: f64) -> f64 {
    psnr.min(PSNR_CAP_DB)
}

/// Mean of each scene's views, for the scenes that have a value; the map keeps a scene's views together.
fn scene_means(views: &ViewsOfSetting, value: impl Fn(&Measured) -> Option<f64>) -> Vec<f64> {
    let views: Vec<_> = views.iter().collect();
    views
        .chunk_by(|((a, _), _), ((b, _), _)| a == b)
        .filter_map(|scene| mean(&scene.iter().filter_map(|(_, view)| value(view)).collect::<Vec<_>>()))
        .collect()
}

/// Mean PSNR of every scene.
pub(crate) fn scene_values(views: &ViewsOfSetting) -> BTreeMap<&str, f64> {
    let mut scenes: BTreeMap<&str, Vec<f64>> = BTreeMap::new();
    for ((scene, _), view) in views {
        scenes.entry(scene).or_default().push(capped(view.psnr));
    }
    scenes.into_iter().filter_map(|(scene, psnr)| Some((scene, mean(&psnr)?))).collect()
}

pub(crate) fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// Sample standard deviation over the square root of the count.
pub(crate) fn standard_error(values: &[f64]) -> Option<f64> {
    let count = values.len() as f64;
    let mean = mean(values)?;
    let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    (values.len() > 1).then(|| (squares / (count - 1.0) / count).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::measured::{Cost, Measured};

    const SETTING: Setting = Setting { variant: Variant::Clift, num_storage_tokens: 64, num_render_tokens: 32 };

    fn measured(views: &[(&str, usize, f64)]) -> Accumulator {
        let mut accumulator = Accumulator::default();
        for &(scene, frame, psnr) in views {
            accumulator.add(scene, frame, SETTING, Measured::quality(psnr, Some(psnr / 100.0))).unwrap();
        }
        accumulator
    }

    #[test]
    fn a_scene_with_many_views_weighs_no_more_than_one_with_few() {
        let summary = measured(&[("a", 0, 20.0), ("a", 1, 22.0), ("a", 2, 24.0), ("b", 0, 30.0)]).summary();
        let point = &summary.points[0];
        assert_eq!((point.psnr, point.psnr_per_view), (Some(26.0), Some(24.0)));
        // Scene means 22 and 30: standard deviation sqrt(32), over sqrt(2).
        assert_eq!(point.psnr_stderr, Some(4.0));
        assert_eq!((summary.num_scenes, summary.num_views), (2, 4));
    }

    #[test]
    fn the_standard_error_of_one_scene_is_not_known() {
        assert_eq!(measured(&[("a", 0, 20.0), ("a", 1, 22.0)]).summary().points[0].psnr_stderr, None);
    }

    #[test]
    fn an_identical_picture_counts_as_the_cap_and_is_counted() {
        let point = measured(&[("a", 0, f64::INFINITY), ("b", 0, 20.0)]).summary().points.remove(0);
        assert_eq!((point.psnr, point.num_identical_views), (Some(60.0), 1));
    }

    #[test]
    fn the_summary_does_not_depend_on_the_order_of_the_views() {
        // Sums of these differ in the last bit when they are added in another order.
        let mut views = [("a", 0, 20.1), ("a", 1, 22.7), ("a", 2, 1e-9), ("b", 0, 30.3), ("c", 5, 17.77)];
        let summary = measured(&views).summary();
        views.reverse();
        assert_eq!(measured(&views).summary(), summary);
    }

    #[test]
    fn what_was_not_measured_is_null_and_the_file_has_the_documented_names() {
        let mut views = measured(&[("a", 0, 20.0)]);
        views.add("a", 0, Setting::baseline(Variant::NearestView), Measured::quality(18.0, Some(0.5))).unwrap();
        views.set_cost(SETTING, Cost { gflops: Some(2.5), scene_bytes: Some(99_000) });
        views.skip("c");
        let folder = tempfile::tempdir().unwrap();
        views.summary().write(&folder.path().join("summary.json")).unwrap();
        let text = std::fs::read_to_string(folder.path().join("summary.json")).unwrap();
        let expected = serde_json::json!({
            "num_scenes": 1, "num_views": 1, "num_skipped": 1,
            "baselines": {"nearest_view": {"psnr": 18.0, "ssim": 0.5}, "mean_image": {"psnr": null, "ssim": null}},
            "points": [{
                "variant": "clift", "num_storage_tokens": 64, "num_render_tokens": 32,
                "psnr": 20.0, "psnr_stderr": null, "psnr_per_view": 20.0, "num_identical_views": 0,
                "ssim": 0.2, "lpips_vgg": null, "render_s": null, "select_s": null,
                "gflops": 2.5, "scene_bytes": 99_000
            }],
            "differences": [], "adaptive": []
        });
        assert_eq!(serde_json::from_str::<serde_json::Value>(&text).unwrap(), expected);
        assert_eq!(serde_json::from_str::<Summary>(&text).unwrap(), views.summary());
    }

    #[test]
    fn the_table_lines_up() {
        let mut views = measured(&[("a", 0, 20.0), ("b", 0, 21.0)]);
        views.add("a", 0, Setting::baseline(Variant::NearestView), Measured::quality(18.0, Some(0.5))).unwrap();
        views.set_cost(SETTING, Cost { gflops: Some(45.23), scene_bytes: Some(99_000) });
        let expected = "2 views of 2 scenes, 0 scenes left out

variant       stored  rendered  PSNR dB  +- dB   SSIM  LPIPS  select ms  render ms     GMAC  scene kB
nearest_view       -         -    18.00      -  0.500      -          -          -        -         -
mean_image         -         -        -      -      -      -          -          -        -         -
clift             64        32    20.50   0.50  0.205      -          -          -     45.2      99.0
";
        assert_eq!(views.summary().to_string(), expected);
    }
}
