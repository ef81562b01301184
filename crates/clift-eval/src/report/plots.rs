//! The plots of a report: quality against tokens, bytes and time.

use std::collections::{BTreeMap, BTreeSet};

use clift_model::TokenFormat;

use crate::config::method::Method;
use crate::report::axis::{Scale, milliseconds};
use crate::report::plot::{Level, Look, Mark, Plot, Series};
use crate::statistics::summary::{Quality, Summary, SummaryPoint};
use crate::statistics::view_metrics::best_method;

const QUALITY: &str = "PSNR, dB";

/// A plot with heading and note.
pub struct PlotSection {
    /// The quantity on the horizontal axis, in words.
    pub heading: &'static str,
    /// The plot.
    pub plot: Plot,
    /// Note below the plot; may be empty.
    pub note: &'static str,
}

/// Returns the plots that a summary has values for.
pub fn plot_sections(summary: &Summary) -> Vec<PlotSection> {
    let mut sections = vec![PlotSection {
        heading: "Quality against stored tokens",
        plot: by_method(summary, "stored tokens", Scale::LogValues, |point| {
            (point.num_storage_tokens > 0).then_some(point.num_storage_tokens as f64)
        }),
        note: "",
    }];
    if summary.points.iter().any(|point| point.key().is_whole() && point.scene_bytes.is_some()) {
        let kb = |point: &SummaryPoint| point.scene_bytes.map(|bytes| bytes as f64 / 1e3);
        let mut plot = by_method(summary, "scene, kB", Scale::Log, kb);
        let on_front = summary.points.iter().filter(|point| point.pareto_bytes);
        plot.front = on_front.filter_map(|point| Some((kb(point)?, point.psnr?))).collect();
        plot.front.sort_by(|a, b| a.0.total_cmp(&b.0));
        sections.push(PlotSection { heading: "Quality against the size of a scene", plot, note: "" });
    }
    if summary.points.iter().any(|point| !point.key().is_whole()) {
        sections.push(PlotSection {
            heading: "Quality against rendered tokens",
            plot: by_rendered(summary),
            note: "The last mark of a line is rendered from all stored tokens.",
        });
    }
    if summary.points.iter().any(|point| point.frame_median_s.is_some()) {
        let note = "Medians over views, each rendered in a call of its own; includes token selection.";
        sections.push(PlotSection { heading: "Quality against time per frame", plot: by_time(summary), note });
    }
    sections
}

/// Returns the look of a method, the same in every plot.
fn look(summary: &Summary, method: Method) -> Look {
    match method {
        Method::Clift => Look::ALL[0],
        Method::Kmeans => Look::ALL[1],
        Method::Random => Look::ALL[2],
        Method::Patch => Look::ALL[3],
        // Baselines are levels, not series.
        Method::PatchClift | Method::NearestView | Method::MeanImage => Look::ALL[4],
        Method::External(_) => {
            let methods = summary.points.iter().map(|point| point.method);
            let external: BTreeSet<_> = methods.filter(|method| matches!(method, Method::External(_))).collect();
            let index = external.into_iter().position(|other| other == method).unwrap_or_default();
            Look::OTHERS[index % Look::OTHERS.len()]
        }
    }
}

/// Returns whether stored tokens have several number formats, which then have lines of their own.
fn has_formats(summary: &Summary) -> bool {
    let stored = summary.points.iter().filter(|point| point.scene_bytes.is_some());
    stored.filter_map(|point| point.tokens).collect::<BTreeSet<_>>().len() > 1
}

/// Returns a line for every method and number format.
fn series(summary: &Summary, is_joined: bool, mark: impl Fn(&SummaryPoint) -> Option<Mark>) -> Vec<Series> {
    let has_formats = has_formats(summary);
    let mut lines: BTreeMap<(Method, Option<TokenFormat>), Vec<Mark>> = BTreeMap::new();
    for point in &summary.points {
        if let Some(mark) = mark(point) {
            lines.entry((point.method, point.tokens.filter(|_| has_formats))).or_default().push(mark);
        }
    }
    let line = |((method, tokens), marks): ((Method, Option<TokenFormat>), Vec<Mark>)| {
        let mut look = look(summary, method);
        let mut name = method.name().to_owned();
        if let Some(tokens) = tokens.filter(|_| method != Method::Random) {
            // Colour of the method, marker of the format.
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

/// Returns the mark of a point at `x`; `None` without PSNR.
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
    let title = format!("{}{tokens}{format}: {y:.2}{error} dB{time}", point.method.name());
    Some(Mark { x, y, error: point.psnr_stderr, title })
}

/// Plots a line per method over the points that render all stored tokens.
fn by_method(
    summary: &Summary,
    x_label: &'static str,
    x_scale: Scale,
    x: impl Fn(&SummaryPoint) -> Option<f64>,
) -> Plot {
    let whole =
        |point: &SummaryPoint| if point.key().is_whole() { x(point).and_then(|x| mark(point, x)) } else { None };
    let title = format!("PSNR against {x_label}, a line per method, with the standard error over scenes");
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

/// Plots a line per storage count of the best method.
fn by_rendered(summary: &Summary) -> Plot {
    let best = best_method(summary.points.iter().map(SummaryPoint::key));
    let mut lines: BTreeMap<usize, Vec<Mark>> = BTreeMap::new();
    // With several formats, the finest.
    let is_best = |point: &&SummaryPoint| Some(point.method) == best;
    let format = summary.points.iter().filter(is_best).map(|point| point.tokens).min().flatten();
    for point in summary.points.iter().filter(is_best).filter(|point| point.tokens == format) {
        lines.entry(point.num_storage_tokens).or_default().extend(mark(point, point.num_render_tokens as f64));
    }
    lines.retain(|_, marks| marks.len() > 1);
    for marks in lines.values_mut() {
        marks.sort_by(|a, b| a.x.total_cmp(&b.x));
    }
    // With more lines than looks, the largest counts.
    let surplus = lines.len().saturating_sub(Look::ALL.len());
    let series = lines.into_iter().skip(surplus).rev().zip(Look::ALL).map(|((stored, marks), look)| Series {
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

/// Plots every point over its time per frame, and the Pareto front.
fn by_time(summary: &Summary) -> Plot {
    let position = |point: &SummaryPoint| Some((point.frame_median_s? * 1e3, point.psnr?));
    let at_time = |point: &SummaryPoint| {
        let mark = point.frame_median_s.and_then(|seconds| mark(point, seconds * 1e3))?;
        Some(Mark { error: None, ..mark })
    };
    let mut front: Vec<_> = summary.points.iter().filter(|point| point.pareto_time).filter_map(position).collect();
    front.sort_by(|a, b| a.0.total_cmp(&b.0));
    Plot {
        title: "PSNR against time per frame: every point, with the Pareto front".into(),
        x_label: "time per frame, ms",
        x_scale: Scale::Linear,
        y_label: QUALITY,
        series: series(summary, false, at_time),
        levels: Vec::new(),
        front,
    }
}
