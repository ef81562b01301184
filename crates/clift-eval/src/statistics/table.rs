//! The table of a summary, in the terminal and in the report: quality, tokens and cost of every key; `-` was not measured.

use std::fmt;

use clift_core::plural;
use clift_scene::CodedLoss;

use crate::config::method::Method;
use crate::statistics::summary::{Quality, Summary, SummaryPoint};
use crate::statistics::text_table::table;

pub const HEADER: [&str; 16] = [
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
    "scene kB",
    "coded kB",
    "",
];

impl Summary {
    /// Returns the rows below [`HEADER`], baselines first.
    pub(crate) fn rows(&self) -> Vec<[String; HEADER.len()]> {
        let baselines =
            [(Method::NearestView, self.baselines.nearest_view), (Method::MeanImage, self.baselines.mean_image)];
        let baselines = baselines.map(|(method, quality)| baseline_cells(method, quality, self.num_views));
        baselines.into_iter().chain(self.points.iter().map(point_cells)).collect()
    }

    /// Returns what explains the table and its gaps.
    pub(crate) fn notes(&self) -> Vec<String> {
        let mut notes = Vec::new();
        if self.points.iter().any(|point| point.pareto_time || point.pareto_bytes) {
            notes.push(
                "frame ms: median, half ms: the middle half of the frames; methods of equal token counts share their times"
                    .into(),
            );
            notes.push(
                "t: no other point has a higher PSNR without taking clearly longer per frame; b: in as few bytes"
                    .into(),
            );
        }
        if self.points.iter().any(|point| point.cost.coded_bytes.is_some()) {
            notes.push(format!(
                "scene kB: a scene file in the format of the row; coded kB: in the default format of `clift encode`, coded \
                 tokens, which lost at most {} dB where the codec was fitted",
                CodedLoss::default().db()
            ));
        }
        notes.extend(self.facts.selection.map(|selection| format!("rendered tokens were selected by {selection}")));
        let not_measured = self.facts.not_measured.iter();
        notes.extend(not_measured.map(|missing| format!("{} is not measured: {}", missing.metric, missing.reason)));
        notes
    }

    pub(crate) fn difference_lines(&self) -> impl Iterator<Item = String> {
        self.differences.iter().map(|row| {
            let format = row.tokens.map_or_else(String::new, |tokens| tokens.to_string());
            let names = format!("{} - {}", row.method.name(), row.against.name());
            let (count, psnr, error) = (row.num_storage_tokens, row.psnr, cell(row.psnr_stderr, 2));
            format!("{names:<24} {count:>6} tokens {format:<4} {psnr:>+7.2} +- {error} dB")
        })
    }
}

impl fmt::Display for Summary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let split = self.facts.split.map_or_else(String::new, |split| format!(" ({split})"));
        let counts = [(self.num_views, "view"), (self.num_scenes, "scene"), (self.num_skipped, "scene")];
        let [views, scenes, skipped] = counts.map(|(count, noun)| plural(count, noun));
        writeln!(f, "{views} of {scenes}{split}, {skipped} skipped")?;
        if let Some(note) = self.masked_note() {
            writeln!(f, "{note}")?;
        }
        for warning in self.warnings() {
            writeln!(f, "warning: {warning}")?;
        }
        writeln!(f, "\n{}\n", table(HEADER, self.rows()))?;
        for note in self.notes() {
            writeln!(f, "{note}")?;
        }
        if !self.differences.is_empty() {
            writeln!(f, "\nPSNR differences on the same scenes, with standard errors")?;
        }
        self.difference_lines().try_for_each(|line| writeln!(f, "{line}"))
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
    let kb = |bytes: Option<u64>| cell(bytes.map(|bytes| bytes as f64 / 1e3), 1);
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
        cell(point.cost.gflops, if point.cost.gflops.is_some_and(|gflops| gflops < 10.0) { 3 } else { 1 }),
        kb(point.cost.scene_bytes),
        kb(point.cost.coded_bytes),
        [if point.pareto_time { "t" } else { "" }, if point.pareto_bytes { "b" } else { "" }].concat(),
    ]
}

fn cell(value: Option<f64>, decimals: usize) -> String {
    value.map_or_else(|| "-".to_owned(), |value| format!("{value:.decimals$}"))
}

#[cfg(test)]
mod tests {
    use crate::config::method::Method;
    use crate::statistics::eval_results::EvalResults;
    use crate::statistics::summary::Summary;
    use crate::statistics::view_metrics::{Cost, EvalKey, ViewMetrics};
    use crate::testing::CLIFT;

    #[test]
    fn table_columns_are_aligned() {
        let mut views = EvalResults::default();
        for (scene, psnr, ms) in [("a", 20.0, 1.0), ("b", 21.0, 2.0)] {
            let measured = ViewMetrics {
                sharpness: Some(psnr / 25.0),
                render_s: Some(ms * 1e-3),
                select_s: Some(0.01),
                ..ViewMetrics::quality(psnr, Some(psnr / 100.0))
            };
            views.add(scene, 0, CLIFT, measured);
        }
        views.add("a", 0, EvalKey::baseline(Method::NearestView), ViewMetrics::quality(18.0, Some(0.5)));
        let cost = Cost { gflops: Some(45.23), scene_bytes: Some(99_000), coded_bytes: Some(9_950), ..Cost::default() };
        views.costs.insert(CLIFT, cost);
        views.note_not_measured("lpips_vgg", "no weights".into());
        let expected = "\
2 views of 2 scenes, 0 scenes skipped

method        stored  rendered  format  PSNR dB  +- dB  SSIM   LPIPS  sharp  render ms  frame ms  half ms     GMAC  scene kB  coded kB
nearest_view  -       -         -       18.00    -      0.500  -      -      -          -         -           -     -         -
mean_image    -       -         -       -        -      -      -      -      -          -         -           -     -         -
clift         64      32        f16     20.50    0.50   0.205  -      0.82   1.5        11.5      11.2..11.8  45.2  99.0      9.9       tb

frame ms: median, half ms: the middle half of the frames; methods of equal token counts share their times
t: no other point has a higher PSNR without taking clearly longer per frame; b: in as few bytes
scene kB: a scene file in the format of the row; coded kB: in the default format of `clift encode`, coded tokens, \
which lost at most 0.02 dB where the codec was fitted
lpips_vgg is not measured: no weights
";
        assert_eq!(Summary::new(&views).to_string(), expected);
    }
}
