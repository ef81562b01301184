//! The plots of a report: quality against tokens, bytes and time.

use std::collections::{BTreeMap, BTreeSet};

use clift_model::TokenFormat;

use crate::config::method::Method;
use crate::report::axis::{Scale, milliseconds};
use crate::report::plot::{Level, Look, Mark, Plot, Series};
use crate::statistics::summary::{Quality, Summary, SummaryPoint};
use crate::statistics::view_metrics::best_variant;

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
        plot: by_variant(summary, "stored tokens", Scale::LogValues, |point| {
            (point.num_storage_tokens > 0).then_some(point.num_storage_tokens as f64)
        }),
        note: "",
    }];
    if summary.points.iter().any(|point| point.key().is_whole() && point.scene_bytes.is_some()) {
        let kb = |point: &SummaryPoint| point.scene_bytes.map(|bytes| bytes as f64 / 1e3);
        let mut plot = by_variant(summary, "scene, kB", Scale::Log, kb);
        let on_front = summary.points.iter().filter(|point| point.pareto_bytes);
        plot.front = on_front.filter_map(|point| Some((kb(point)?, point.psnr?))).collect();
        plot.front.sort_by(|a, b| a.0.total_cmp(&b.0));
        figures.push(Figure { heading: "Quality against the size of a scene", plot, note: "" });
    }
    if summary.points.iter().any(|point| !point.key().is_whole()) {
        figures.push(Figure {
            heading: "Quality against rendered tokens",
            plot: by_rendered(summary),
            note: "The last mark of a line is drawn from all tokens that are stored.",
        });
    }
    if summary.points.iter().any(|point| point.frame_median_s.is_some()) {
        let note =
            "Each view is drawn alone, the choice of its tokens included where they are chosen: medians over views.";
        figures.push(Figure { heading: "Quality against time per frame", plot: by_time(summary), note });
    }
    figures
}

/// The look of a variant, the same in every plot.
fn look(summary: &Summary, variant: Method) -> Look {
    let ours = |i: usize| Look::ALL[i];
    match variant {
        Method::Clift => ours(0),
        Method::Kmeans => ours(1),
        Method::Random => ours(2),
        Method::Patch => ours(3),
        // Baselines are levels, not series.
        Method::PatchClift | Method::NearestView | Method::MeanImage => ours(4),
        Method::System(_) => {
            let is_system = |variant: &Method| matches!(variant, Method::System(_));
            let systems: BTreeSet<_> = summary.points.iter().map(|point| point.variant).filter(is_system).collect();
            let place = systems.into_iter().position(|system| system == variant).unwrap_or_default();
            Look::OTHERS[place % Look::OTHERS.len()]
        }
    }
}

/// Whether stored tokens have several number formats, so that lines are told apart by them too.
fn has_formats(summary: &Summary) -> bool {
    let stored = summary.points.iter().filter(|point| point.scene_bytes.is_some());
    stored.filter_map(|point| point.tokens).collect::<BTreeSet<_>>().len() > 1
}

/// A line for every variant and number format, in its look.
fn series(summary: &Summary, is_joined: bool, mark: impl Fn(&SummaryPoint) -> Option<Mark>) -> Vec<Series> {
    let has_formats = has_formats(summary);
    let mut lines: BTreeMap<(Method, Option<TokenFormat>), Vec<Mark>> = BTreeMap::new();
    for point in &summary.points {
        if let Some(mark) = mark(point) {
            lines.entry((point.variant, point.tokens.filter(|_| has_formats))).or_default().push(mark);
        }
    }
    let line = |((variant, tokens), marks): ((Method, Option<TokenFormat>), Vec<Mark>)| {
        let mut look = look(summary, variant);
        let mut name = variant.name().to_owned();
        if let Some(tokens) = tokens.filter(|_| variant != Method::Random) {
            // The colour is the variant's, the marker the format's.
            let format = TokenFormat::ALL.iter().position(|format| *format == tokens).unwrap_or_default();
            look.marker = Look::ALL[format].marker;
            name = format!("{name}, {}", tokens.name());
        }
        Series { name, look, is_joined, marks }
    };
    lines.into_iter().map(line).collect()
}

fn levels(summary: &Summary) -> Vec<Level> {
    let baselines = summary.baselines;
    let all = [("nearest view", "nearest", baselines.nearest_view), ("mean image", "mean", baselines.mean_image)];
    let level = |(name, class, quality): (&str, _, Quality)| Some(Level { name: name.into(), class, y: quality.psnr? });
    all.into_iter().filter_map(level).collect()
}

/// The mark of a point at `x`, if its quality is known.
fn mark(point: &SummaryPoint, x: f64) -> Option<Mark> {
    let y = point.psnr?;
    let SummaryPoint { num_storage_tokens: stored, num_render_tokens: rendered, .. } = *point;
    let tokens = match (stored, point.key().is_whole()) {
        (0, _) => String::new(),
        (_, true) => format!(", {stored} tokens"),
        (_, false) => format!(", {rendered} of {stored} tokens"),
    };
    let format = point.tokens.map(|tokens| format!(" in {}", tokens.name())).unwrap_or_default();
    let error = point.psnr_stderr.map(|error| format!(" \u{b1} {error:.2}")).unwrap_or_default();
    let time = point.frame_median_s.map(|s| format!(", {} ms per frame", milliseconds(s))).unwrap_or_default();
    let title = format!("{}{tokens}{format}: {y:.2}{error} dB{time}", point.variant.name());
    Some(Mark { x, y, error: point.psnr_stderr, title })
}

/// A line per variant, of the points that are drawn from all they store.
fn by_variant(
    summary: &Summary,
    x_label: &'static str,
    x_scale: Scale,
    x: impl Fn(&SummaryPoint) -> Option<f64>,
) -> Plot {
    let whole =
        |point: &SummaryPoint| if point.key().is_whole() { x(point).and_then(|x| mark(point, x)) } else { None };
    let title = format!("PSNR against {x_label}, a line per variant, with the standard error over scenes");
    Plot {
        title,
        x_label,
        x_scale,
        y_label: QUALITY,
        series: series(summary, true, whole),
        levels: levels(summary),
        front: Vec::new(),
    }
}

/// A line per storage count of the best variant.
fn by_rendered(summary: &Summary) -> Plot {
    let best = best_variant(summary.points.iter().map(SummaryPoint::key));
    let mut lines: BTreeMap<usize, Vec<Mark>> = BTreeMap::new();
    // Of the finest format, where there are several.
    let is_best = |point: &&SummaryPoint| Some(point.variant) == best;
    let format = summary.points.iter().filter(is_best).map(|point| point.tokens).min().flatten();
    for point in summary.points.iter().filter(is_best).filter(|point| point.tokens == format) {
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
    let place = |point: &SummaryPoint| Some((point.frame_median_s? * 1e3, point.psnr?));
    let at_time = |point: &SummaryPoint| {
        let mark = point.frame_median_s.and_then(|seconds| mark(point, seconds * 1e3))?;
        Some(Mark { error: None, ..mark })
    };
    let mut front: Vec<_> = summary.points.iter().filter(|point| point.pareto_time).filter_map(place).collect();
    front.sort_by(|a, b| a.0.total_cmp(&b.0));
    Plot {
        title: "PSNR against time per frame, every point, with the Pareto front".into(),
        x_label: "time per frame, ms",
        x_scale: Scale::Linear,
        y_label: QUALITY,
        series: series(summary, false, at_time),
        levels: Vec::new(),
        front,
    }
}
