//! The plots of a report: quality against tokens, bytes and time.

use std::collections::{BTreeMap, BTreeSet};

use clift_scene::TokenCoding;

use crate::config::method::Method;
use crate::report::axis::{Scale, milliseconds};
use crate::report::plot::{Level, Look, Mark, Plot, Series};
use crate::statistics::summary::{Quality, Summary, SummaryPoint};
use crate::statistics::view_metrics::EvalKey;

/// Returns the plots that a summary has values for.
pub fn plots(summary: &Summary) -> Vec<Plot> {
    let has = |test: fn(&SummaryPoint) -> bool| summary.points.iter().any(test);
    let stored = |point: &SummaryPoint| Some(point.key.num_storage_tokens as f64).filter(|count| *count > 0.0);
    let mut plots = vec![Plot {
        heading: "Quality against stored tokens",
        ..by_method(summary, "stored tokens", Scale::LogValues, stored)
    }];
    if has(|point| point.key.is_whole() && point.cost.scene_bytes.is_some()) {
        let kb = |point: &SummaryPoint| point.cost.scene_kb();
        plots.push(Plot {
            heading: "Quality against the size of a scene",
            note: "Sizes are those of the evaluated formats. Coded tokens, which clift encode writes by default, take a \
                   fraction of them: eval --format f32,coded measures both.",
            front: front(summary, |point| point.pareto_bytes, kb),
            ..by_method(summary, "scene, kB", Scale::Log, kb)
        });
    }
    // Of one network, values are tokens and work is nearly linear in them.
    if has(|point| point.key.method.network().is_some()) && has(|point| point.key.method == Method::Clift) {
        let values = |point: &SummaryPoint| point.cost.scene_values.map(|count| count as f64);
        let gmac = |point: &SummaryPoint| point.cost.gflops;
        plots.push(Plot {
            heading: "Quality against stored values",
            ..by_method(summary, "stored values", Scale::LogValues, values)
        });
        plots.push(Plot {
            heading: "Quality against the work of a view",
            ..by_method(summary, "GMAC per view", Scale::Log, gmac)
        });
    }
    if has(|point| !point.key.is_whole()) {
        plots.push(by_rendered(summary));
    }
    if has(|point| point.frame_median_s.is_some()) {
        plots.push(by_time(summary));
    }
    plots
}

/// Returns the look of a method, the same in every plot.
fn look(summary: &Summary, method: Method) -> Look {
    match method {
        Method::Clift => Look::ALL[0],
        Method::Kmeans => Look::ALL[1],
        Method::Random => Look::ALL[2],
        Method::Tile => Look::ALL[3],
        // Baselines are levels, not series.
        Method::TileClift | Method::NearestView | Method::MeanImage => Look::ALL[4],
        Method::Whole(_) | Method::External(_) => {
            let is_other = |method: &Method| matches!(method, Method::Whole(_) | Method::External(_));
            let methods = summary.points.iter().map(|point| point.key.method);
            let others: BTreeSet<_> = methods.filter(is_other).collect();
            let index = others.into_iter().position(|other| other == method).unwrap_or_default();
            Look::OTHERS[index % Look::OTHERS.len()]
        }
    }
}

/// Returns whether stored tokens have several number formats, which then have lines of their own.
fn has_formats(summary: &Summary) -> bool {
    let stored = summary.points.iter().filter(|point| point.cost.scene_bytes.is_some());
    stored.filter_map(|point| point.key.tokens).collect::<BTreeSet<_>>().len() > 1
}

fn series(summary: &Summary, is_joined: bool, mark: impl Fn(&SummaryPoint) -> Option<Mark>) -> Vec<Series> {
    let has_formats = has_formats(summary);
    let formats: BTreeSet<TokenCoding> = summary.points.iter().filter_map(|point| point.key.tokens).collect();
    let mut lines: BTreeMap<(Method, Option<TokenCoding>), Vec<Mark>> = BTreeMap::new();
    for point in &summary.points {
        if let Some(mark) = mark(point) {
            lines.entry((point.key.method, point.key.tokens.filter(|_| has_formats))).or_default().push(mark);
        }
    }
    let line = |((method, tokens), marks): ((Method, Option<TokenCoding>), Vec<Mark>)| {
        let mut look = look(summary, method);
        let mut name = method.name().to_owned();
        if let Some(tokens) = tokens.filter(|_| method != Method::Random) {
            // Colour of the method, marker of the format.
            let format = formats.iter().position(|format| *format == tokens).unwrap_or_default();
            look.marker = Look::ALL[format % Look::ALL.len()].marker;
            name = format!("{name}, {tokens}");
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
    let y = point.quality.psnr?;
    let EvalKey { num_storage_tokens: stored, num_render_tokens: rendered, .. } = point.key;
    let tokens = match (stored, point.key.is_whole()) {
        (0, _) => String::new(),
        (_, true) => format!(", {stored} tokens"),
        (_, false) => format!(", {rendered} of {stored} tokens"),
    };
    let format = point.key.tokens.map(|tokens| format!(" in {tokens}")).unwrap_or_default();
    let error = point.psnr_stderr.map(|error| format!(" \u{b1} {error:.2}")).unwrap_or_default();
    let time = point.frame_median_s.map(|s| format!(", {} ms per frame", milliseconds(s))).unwrap_or_default();
    let title = format!("{}{tokens}{format}: {y:.2}{error} dB{time}", point.key.method.name());
    Some(Mark { x, y, error: point.psnr_stderr, title })
}

/// Plots a line per method over the points that render all stored tokens.
fn by_method(
    summary: &Summary,
    x_label: &'static str,
    x_scale: Scale,
    x: impl Fn(&SummaryPoint) -> Option<f64>,
) -> Plot {
    let whole = |point: &SummaryPoint| if point.key.is_whole() { x(point).and_then(|x| mark(point, x)) } else { None };
    Plot {
        title: format!("PSNR against {x_label}, a line per method, with the standard error over scenes"),
        x_label,
        x_scale,
        series: series(summary, true, whole),
        levels: levels(summary),
        ..Plot::default()
    }
}

/// Plots a line per storage count of the best method.
fn by_rendered(summary: &Summary) -> Plot {
    let mut lines: BTreeMap<usize, Vec<Mark>> = BTreeMap::new();
    for point in summary.best_points() {
        lines.entry(point.key.num_storage_tokens).or_default().extend(mark(point, point.key.num_render_tokens as f64));
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
        heading: "Quality against rendered tokens",
        title: "PSNR against rendered tokens, a line per number of stored tokens".into(),
        x_label: "rendered tokens",
        x_scale: Scale::LogValues,
        series: series.collect(),
        levels: levels(summary),
        note: "The last mark of a line is rendered from all stored tokens.",
        ..Plot::default()
    }
}

/// Plots every point over its time per frame, and the Pareto front.
fn by_time(summary: &Summary) -> Plot {
    let frame_ms = |point: &SummaryPoint| Some(point.frame_median_s? * 1e3);
    let at_time = |point: &SummaryPoint| Some(Mark { error: None, ..mark(point, frame_ms(point)?)? });
    Plot {
        heading: "Quality against time per frame",
        title: "PSNR against time per frame: every point, with the Pareto front".into(),
        x_label: "time per frame, ms",
        series: series(summary, false, at_time),
        front: front(summary, |point| point.pareto_time, frame_ms),
        note: "Medians over views, each rendered in a call of its own; includes token selection.",
        ..Plot::default()
    }
}

/// Returns the points of a Pareto front, by ascending x.
fn front(
    summary: &Summary,
    is_on_front: fn(&SummaryPoint) -> bool,
    x: impl Fn(&SummaryPoint) -> Option<f64>,
) -> Vec<(f64, f64)> {
    let points = summary.points.iter().filter(|point| is_on_front(point));
    let mut front: Vec<_> = points.filter_map(|point| Some((x(point)?, point.quality.psnr?))).collect();
    front.sort_by(|a, b| a.0.total_cmp(&b.0));
    front
}
