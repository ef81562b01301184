//! The terminal table of a summary: quality, tokens and cost of every key; `-` was not measured.

use std::fmt;

use clift_data::plural;

use crate::config::method::Method;
use crate::statistics::paired::PairedDifference;
use crate::statistics::summary::{Quality, Summary, SummaryPoint};
use crate::statistics::text_table::table;

/// Largest number of missing images in the table; `summary.json` has all.
const MAX_NAMED: usize = 3;

const HEADER: [&str; 16] = [
    "method",
    "stored",
    "rendered",
    "format",
    "PSNR dB",
    "+- dB",
    "SSIM",
    "LPIPS",
    "sharp",
    "render ms",
    "frame ms",
    "half ms",
    "GMAC",
    "values",
    "scene kB",
    "",
];

impl fmt::Display for Summary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { num_scenes, num_views, num_skipped, baselines, points, differences, .. } = self;
        let split = self.split.map_or_else(String::new, |split| format!(" ({split})"));
        let [views, scenes, skipped] = [(*num_views, "view"), (*num_scenes, "scene"), (*num_skipped, "scene")]
            .map(|(count, noun)| plural(count, noun));
        writeln!(f, "{views} of {scenes}{split}, {skipped} skipped")?;
        if let Some(note) = self.masked_note() {
            writeln!(f, "{note}")?;
        }
        for warning in self.warnings() {
            writeln!(f, "warning: {warning}")?;
        }
        writeln!(f)?;
        let baselines = baselines.list().map(|(method, quality)| baseline_cells(method, quality, *num_views));
        writeln!(f, "{}", table(HEADER, baselines.into_iter().chain(points.iter().map(point_cells))))?;
        if points.iter().any(|point| point.pareto_time || point.pareto_bytes) {
            writeln!(
                f,
                "\nframe ms: median, half ms: the middle half of the frames; methods of equal token counts share their times\nt: no other point has a higher PSNR without taking clearly longer per frame; b: in as few bytes"
            )?;
        }
        if let Some(selection) = self.selection {
            writeln!(f, "\nrendered tokens were selected by {selection}")?;
        }
        if !differences.is_empty() {
            writeln!(f, "\nPSNR differences on the same scenes, with standard errors")?;
        }
        for PairedDifference { method, against, num_storage_tokens, tokens, psnr, psnr_stderr, .. } in differences {
            let (error, format) = (cell(*psnr_stderr, 2), tokens.map_or_else(String::new, |tokens| tokens.to_string()));
            let names = format!("{} - {}", method.name(), against.name());
            writeln!(f, "{names:<24} {num_storage_tokens:>6} tokens {format:<4} {psnr:>+7.2} +- {error} dB")?;
        }
        for missing in &self.missing {
            let named = missing.images.iter().take(MAX_NAMED).cloned().collect::<Vec<_>>().join(", ");
            let more = if missing.images.len() > MAX_NAMED { ", .." } else { "" };
            let (name, count) = (missing.method.name(), missing.num_missing);
            writeln!(f, "{name}: {count} of {num_views} images are missing; means are over the others: {named}{more}")?;
        }
        for missing in &self.not_measured {
            writeln!(f, "{} is not measured: {}", missing.metric, missing.reason)?;
        }
        Ok(())
    }
}

fn baseline_cells(method: Method, quality: Quality, num_views: usize) -> [String; HEADER.len()] {
    let Quality { psnr, ssim, lpips_vgg, sharpness, num_identical_views } = quality;
    let mut cells = HEADER.map(|_| cell(None, 0));
    cells[0] = method.name().into();
    (cells[4], cells[6], cells[7], cells[8]) = (cell(psnr, 2), cell(ssim, 3), cell(lpips_vgg, 3), cell(sharpness, 2));
    let has_copies = num_identical_views > 0;
    let copies = has_copies.then(|| format!("{num_identical_views} of {num_views} views identical to the target"));
    cells[15] = copies.unwrap_or_default();
    cells
}

fn point_cells(point: &SummaryPoint) -> [String; HEADER.len()] {
    let count = |count: usize| if count == 0 { cell(None, 0) } else { count.to_string() };
    let ms = |seconds: Option<f64>| cell(seconds.map(|seconds| seconds * 1e3), 1);
    let quartiles = point.frame_quartiles_s.map(|[low, high]| format!("{:.1}..{:.1}", low * 1e3, high * 1e3));
    [
        point.key.method.name().into(),
        count(point.key.num_storage_tokens),
        count(point.key.num_render_tokens),
        point.key.tokens.map_or_else(|| cell(None, 0), |tokens| tokens.to_string()),
        cell(point.quality.psnr, 2),
        cell(point.psnr_stderr, 2),
        cell(point.quality.ssim, 3),
        cell(point.quality.lpips_vgg, 3),
        cell(point.quality.sharpness, 2),
        ms(point.render_median_s),
        ms(point.frame_median_s),
        quartiles.unwrap_or_else(|| cell(None, 0)),
        cell(point.cost.gflops, point.cost.gflops_decimals()),
        point.cost.scene_values.map_or_else(|| cell(None, 0), |values| values.to_string()),
        cell(point.cost.scene_kb(), 1),
        [if point.pareto_time { "t" } else { "" }, if point.pareto_bytes { "b" } else { "" }].concat(),
    ]
}

fn cell(value: Option<f64>, decimals: usize) -> String {
    value.map_or_else(|| "-".to_owned(), |value| format!("{value:.decimals$}"))
}

#[cfg(test)]
mod tests {
    use clift_scene::TokenCoding;

    use crate::config::method::{Method, MethodName};
    use crate::statistics::eval_results::EvalResults;
    use crate::statistics::summary::Summary;
    use crate::statistics::view_metrics::{Cost, EvalKey, ViewMetrics};
    use crate::testing::CLIFT;

    #[test]
    fn table_columns_are_aligned() {
        let mut views = EvalResults::default();
        let key = EvalKey { tokens: Some(TokenCoding::INT8), ..CLIFT };
        for (scene, psnr, ms) in [("a", 20.0, 1.0), ("b", 21.0, 2.0)] {
            let measured = ViewMetrics {
                sharpness: Some(psnr / 25.0),
                render_s: Some(ms * 1e-3),
                select_s: Some(0.01),
                ..ViewMetrics::quality(psnr, Some(psnr / 100.0))
            };
            views.add(scene, 0, key, measured);
        }
        let name = MethodName::new("DepthSplat").unwrap();
        let other = EvalKey::baseline(Method::External(name));
        views.add("a", 0, other, ViewMetrics { lpips_vgg: Some(0.25), ..ViewMetrics::quality(19.0, None) });
        views.record_missing_image(other.method, "b/000000.png".into());
        views.add("a", 0, EvalKey::baseline(Method::NearestView), ViewMetrics::quality(18.0, Some(0.5)));
        let cost =
            Cost { gflops: Some(45.23), scene_values: Some(49_152), scene_bytes: Some(99_000), ..Cost::default() };
        views.costs.insert(key, cost);
        views.note_not_measured("lpips_vgg", "no weights".into());
        let expected = "\
2 views of 2 scenes, 0 scenes skipped

method        stored  rendered  format  PSNR dB  +- dB  SSIM   LPIPS  sharp  render ms  frame ms  half ms     GMAC  values  scene kB
nearest_view  -       -         -       18.00    -      0.500  -      -      -          -         -           -     -       -
mean_image    -       -         -       -        -      -      -      -      -          -         -           -     -       -
clift         64      32        int8    20.50    0.50   0.205  -      0.82   1.5        11.5      11.2..11.8  45.2  49152   99.0      tb
DepthSplat    -       -         -       19.00    -      -      0.250  -      -          -         -           -     -       -

frame ms: median, half ms: the middle half of the frames; methods of equal token counts share their times
t: no other point has a higher PSNR without taking clearly longer per frame; b: in as few bytes
DepthSplat: 1 of 2 images are missing; means are over the others: b/000000.png
lpips_vgg is not measured: no weights
";
        assert_eq!(Summary::new(&views).to_string(), expected);
    }
}
