//! The plots of a report: quality against tokens, bytes and time.

use std::collections::BTreeMap;

use super::axis::{Scale, milliseconds};
use super::pareto::front;
use super::plot::{Level, Look, Mark, Plot, Series};
use crate::exhibit::best_variant;
use crate::measured::{Setting, Variant};
use crate::summary::{Point, Summary};

const QUALITY: &str = "PSNR, dB";

/// A plot under a heading.
pub struct Figure {
    /// What it shows.
    pub heading: &'static str,
    /// The plot.
    pub plot: Plot,
    /// What has to be known to read it; may be empty.
    pub note: &'static str,
}

/// The figures that a summary has values for.
pub fn figures(summary: &Summary) -> Vec<Figure> {
    let mut figures = vec![Figure {
        heading: "Quality against stored tokens",
        plot: by_variant(summary, "stored tokens", Scale::LogValues, |point| Some(point.num_storage_tokens as f64)),
        note: "",
    }];
    if summary.points.iter().any(|point| is_whole(point) && point.scene_bytes.is_some()) {
        figures.push(Figure {
            heading: "Quality against the size of a scene",
            plot: by_variant(summary, "scene file, kB", Scale::Log, |point| {
                point.scene_bytes.map(|bytes| bytes as f64 / 1e3)
            }),
            note: "",
        });
    }
    if summary.points.iter().any(|point| !is_whole(point)) {
        figures.push(Figure {
            heading: "Quality against rendered tokens",
            plot: by_rendered(summary),
            note: "The last mark of a line is drawn from all tokens that are stored.",
        });
    }
    if summary.points.iter().any(|point| seconds(point).is_some()) {
        let note = if summary.points.iter().all(is_whole) {
            ""
        } else {
            "Views from all stored tokens are drawn up to eight at a time and share keys and values; views from chosen \
             tokens are drawn one by one, the choice included."
        };
        figures.push(Figure { heading: "Quality against time per frame", plot: by_time(summary), note });
    }
    figures
}

/// The setting of a point.
pub fn setting(point: &Point) -> Setting {
    let Point { variant, num_storage_tokens, num_render_tokens, .. } = *point;
    Setting { variant, num_storage_tokens, num_render_tokens }
}

/// Whether a point's views are drawn from all tokens that are stored.
pub fn is_whole(point: &Point) -> bool {
    point.num_render_tokens == point.num_storage_tokens
}

/// Time per frame: choosing tokens and drawing.
pub fn seconds(point: &Point) -> Option<f64> {
    point.render_s.map(|render_s| render_s + point.select_s.unwrap_or_default())
}

/// Points that no other beats in both time per frame and PSNR.
pub fn fastest(points: &[Point]) -> Vec<usize> {
    let value = |value: Option<f64>| value.unwrap_or(f64::NAN);
    front(&points.iter().map(|point| (value(seconds(point)), value(point.psnr))).collect::<Vec<_>>())
}

/// The look of a variant, the same in every plot.
const fn look(variant: Variant) -> Look {
    Look::ALL[match variant {
        Variant::Clift => 0,
        Variant::Kmeans => 1,
        Variant::Random => 2,
        Variant::Patch => 3,
        // Baselines are levels, not series.
        Variant::PatchClift | Variant::NearestView | Variant::MeanImage => 4,
    }]
}

fn levels(summary: &Summary) -> Vec<Level> {
    let baselines = summary.baselines;
    let all = [("nearest view", "nearest", baselines.nearest_view), ("mean image", "mean", baselines.mean_image)];
    let level = |(name, class, quality): (&str, _, crate::summary::Quality)| {
        Some(Level { name: name.into(), class, y: quality.psnr? })
    };
    all.into_iter().filter_map(level).collect()
}

/// The mark of a point at `x`, if its quality is known.
fn mark(point: &Point, x: f64) -> Option<Mark> {
    let y = point.psnr?;
    let Point { num_storage_tokens: stored, num_render_tokens: rendered, .. } = *point;
    let tokens = if is_whole(point) { format!("{stored} tokens") } else { format!("{rendered} of {stored} tokens") };
    let error = point.psnr_stderr.map(|error| format!(" \u{b1} {error:.2}")).unwrap_or_default();
    let time = seconds(point).map(|s| format!(", {} ms per frame", milliseconds(s))).unwrap_or_default();
    let title = format!("{}, {tokens}: {y:.2}{error} dB{time}", point.variant.name());
    Some(Mark { x, y, error: point.psnr_stderr, title })
}

/// A line per variant, of the points that are drawn from all they store.
fn by_variant(summary: &Summary, x_label: &'static str, x_scale: Scale, x: impl Fn(&Point) -> Option<f64>) -> Plot {
    let mut series: BTreeMap<Variant, Vec<Mark>> = BTreeMap::new();
    for point in summary.points.iter().filter(|point| is_whole(point)) {
        if let Some(mark) = x(point).and_then(|x| mark(point, x)) {
            series.entry(point.variant).or_default().push(mark);
        }
    }
    let series = series.into_iter().map(|(variant, marks)| Series {
        name: variant.name().into(),
        look: look(variant),
        is_joined: true,
        marks,
    });
    let title = format!("PSNR against {x_label}, a line per variant, with the standard error over scenes");
    Plot {
        title,
        x_label,
        x_scale,
        y_label: QUALITY,
        series: series.collect(),
        levels: levels(summary),
        front: Vec::new(),
    }
}

/// A line per storage count of the best variant.
fn by_rendered(summary: &Summary) -> Plot {
    let best = best_variant(summary.points.iter().map(setting));
    let mut lines: BTreeMap<usize, Vec<Mark>> = BTreeMap::new();
    for point in summary.points.iter().filter(|point| Some(point.variant) == best) {
        lines.entry(point.num_storage_tokens).or_default().extend(mark(point, point.num_render_tokens as f64));
    }
    lines.retain(|_, marks| marks.len() > 1);
    for marks in lines.values_mut() {
        marks.sort_by(|a, b| a.x.total_cmp(&b.x));
    }
    // The largest counts, where there are more lines than looks.
    let surplus = lines.len().saturating_sub(Look::ALL.len());
    let looks = Look::ALL.into_iter().cycle();
    let series = lines.into_iter().skip(surplus).rev().zip(looks).map(|((stored, marks), look)| Series {
        name: format!("{stored} stored"),
        look,
        is_joined: true,
        marks,
    });
    Plot {
        title: "PSNR against rendered tokens, a line per number of stored tokens".into(),
        x_label: "rendered tokens",
        x_scale: Scale::LogValues,
        y_label: QUALITY,
        series: series.collect(),
        levels: levels(summary),
        front: Vec::new(),
    }
}

/// Every point over its time per frame, and the front.
fn by_time(summary: &Summary) -> Plot {
    let mut series: BTreeMap<Variant, Vec<Mark>> = BTreeMap::new();
    for point in &summary.points {
        if let Some(mark) = seconds(point).and_then(|seconds| mark(point, seconds * 1e3)) {
            series.entry(point.variant).or_default().push(Mark { error: None, ..mark });
        }
    }
    let on_front = fastest(&summary.points);
    let place = |i: usize| {
        let point = &summary.points[i];
        Some((seconds(point)? * 1e3, point.psnr?))
    };
    let series = series.into_iter().map(|(variant, marks)| Series {
        name: variant.name().into(),
        look: look(variant),
        is_joined: false,
        marks,
    });
    Plot {
        title: "PSNR against time per frame, every point, with the Pareto front".into(),
        x_label: "time per frame, ms",
        x_scale: Scale::Linear,
        y_label: QUALITY,
        series: series.collect(),
        levels: Vec::new(),
        front: on_front.into_iter().filter_map(place).collect(),
    }
}
