//! The plots of a report: quality against tokens, bytes and time.

use std::collections::{BTreeMap, BTreeSet};

use clift_scene::{CodedLoss, TokenCoding};

use crate::config::method::Method;
use crate::report::plot::{Mark, Plot, Series};
use crate::statistics::summary::{Summary, SummaryPoint};

const METHODS: [Method; 5] = [Method::Clift, Method::Kmeans, Method::Random, Method::Tile, Method::TileClift];

pub fn plots(summary: &Summary) -> Vec<Plot> {
    let has = |test: fn(&SummaryPoint) -> bool| summary.points.iter().any(test);
    let whole = |x: fn(&SummaryPoint) -> Option<f64>| {
        move |point: &SummaryPoint| if point.key.is_whole() { x(point) } else { None }
    };
    let plot = |heading, x_label, series: Vec<Series>| Plot {
        heading,
        x_label,
        is_log: true,
        series,
        levels: levels(summary),
        note: String::new(),
    };
    let stored = |point: &SummaryPoint| Some(point.key.num_storage_tokens as f64).filter(|count| *count > 0.0);
    let mut plots =
        vec![plot("Quality against stored tokens", "stored tokens", series(summary, true, whole(stored), |_| false))];
    if has(|point| point.key.is_whole() && point.cost.scene_bytes.is_some()) {
        let kb = |point: &SummaryPoint| point.cost.scene_bytes.map(|bytes| bytes as f64 / 1e3);
        let mut lines = series(summary, true, whole(kb), |point| point.pareto_bytes);
        let coded = coded_series(summary);
        let note = if coded.is_some() {
            format!(
                "Sizes in the formats of the evaluation, and of the default format of clift encode, coded tokens, at the \
                 PSNR of plain ones: coding lost at most {} dB where the codec was fitted. Rings: the Pareto front.",
                CodedLoss::default().db()
            )
        } else {
            "Sizes in the formats of the evaluation. Rings: the Pareto front.".into()
        };
        lines.extend(coded);
        plots.push(Plot { note, ..plot("Quality against the size of a scene", "scene, kB", lines) });
    }
    // Of one network, values are tokens and work is nearly linear in them.
    if has(|point| point.key.method.network().is_some()) && has(|point| point.key.method == Method::Clift) {
        let values = |point: &SummaryPoint| point.cost.scene_values.map(|count| count as f64);
        let gmac = |point: &SummaryPoint| point.cost.gflops;
        let (values, gmac) =
            (series(summary, true, whole(values), |_| false), series(summary, true, whole(gmac), |_| false));
        plots.push(plot("Quality against stored values", "stored values", values));
        plots.push(plot("Quality against the work of a view", "GMAC per view", gmac));
    }
    if has(|point| !point.key.is_whole()) {
        let note = "The last mark of a line is rendered from all stored tokens.".into();
        plots.push(Plot { note, ..plot("Quality against rendered tokens", "rendered tokens", by_stored(summary)) });
    }
    if has(|point| point.frame_median_s.is_some()) {
        let frame_ms = |point: &SummaryPoint| Some(point.frame_median_s? * 1e3);
        let lines = series(summary, false, frame_ms, |point| point.pareto_time);
        let note = "Medians over views, each rendered in a call of its own; includes token selection. Rings: the Pareto \
                    front.";
        let plot = plot("Quality against time per frame", "time per frame, ms", lines);
        plots.push(Plot { is_log: false, note: note.into(), ..plot });
    }
    plots
}

/// Returns a series per method, and per format where the stored tokens have several.
fn series(
    summary: &Summary,
    is_joined: bool,
    x: impl Fn(&SummaryPoint) -> Option<f64>,
    is_front: fn(&SummaryPoint) -> bool,
) -> Vec<Series> {
    let stored = summary.points.iter().filter(|point| point.cost.scene_bytes.is_some());
    let formats: BTreeSet<Option<TokenCoding>> = stored.map(|point| point.key.tokens).collect();
    let others: BTreeSet<Method> = summary.points.iter().map(|point| point.key.method).collect();
    let methods: Vec<Method> = METHODS.into_iter().chain(others.into_iter().filter(|m| !METHODS.contains(m))).collect();
    let mut lines: BTreeMap<(Method, Option<TokenCoding>), Vec<Mark>> = BTreeMap::new();
    for point in &summary.points {
        if let Some(mark) = x(point).and_then(|x| mark(point, x, is_front(point))) {
            let format = point.key.tokens.filter(|_| formats.len() > 1 && point.key.method != Method::Random);
            lines.entry((point.key.method, format)).or_default().push(mark);
        }
    }
    let line = |((method, format), marks): ((Method, Option<TokenCoding>), Vec<Mark>)| {
        let colour = methods.iter().position(|one| *one == method).unwrap_or_default();
        let of_format = formats.iter().position(|one| *one == format).filter(|_| format.is_some());
        let name = [method.name().to_owned()].into_iter().chain(format.map(|format| format.to_string()));
        let name = name.collect::<Vec<_>>().join(", ");
        Series { name, look: [colour, of_format.unwrap_or(colour)], is_joined, marks }
    };
    lines.into_iter().map(line).collect()
}

/// Returns the sizes in the default format of `clift encode`, where the evaluation has not measured this format.
fn coded_series(summary: &Summary) -> Option<Series> {
    let default = Some(TokenCoding::Coded(CodedLoss::default()));
    if summary.points.iter().any(|point| point.key.tokens == default) {
        return None;
    }
    let points = summary.best_points().filter(|point| point.key.is_whole());
    let marks: Vec<Mark> =
        points.filter_map(|point| mark(point, point.cost.coded_bytes? as f64 / 1e3, false)).collect();
    let name = "clift, coded: the default of clift encode".into();
    (!marks.is_empty()).then_some(Series { name, look: [7, 4], is_joined: true, marks })
}

/// Returns a series per number of stored tokens of the main method, over rendered tokens.
fn by_stored(summary: &Summary) -> Vec<Series> {
    let mut lines: BTreeMap<usize, Vec<Mark>> = BTreeMap::new();
    // By ascending rendered tokens, as all points.
    for point in summary.best_points() {
        let x = point.key.num_render_tokens as f64;
        lines.entry(point.key.num_storage_tokens).or_default().extend(mark(point, x, false));
    }
    lines.retain(|_, marks| marks.len() > 1);
    let line = |(i, (stored, marks)): (usize, _)| Series {
        name: format!("{stored} stored"),
        look: [i, i],
        is_joined: true,
        marks,
    };
    lines.into_iter().rev().enumerate().map(line).collect()
}

fn levels(summary: &Summary) -> Vec<(&'static str, f64)> {
    let baselines = summary.baselines;
    let all = [("nearest view", baselines.nearest_view), ("mean image", baselines.mean_image)];
    all.into_iter().filter_map(|(name, quality)| Some((name, quality.psnr?))).collect()
}

fn mark(point: &SummaryPoint, x: f64, is_front: bool) -> Option<Mark> {
    let y = point.quality.psnr?;
    let time = point.frame_median_s.map_or_else(String::new, |s| format!(", {:.2} ms per frame", s * 1e3));
    Some(Mark { x, y, error: point.psnr_stderr, is_front, title: format!("{}: {y:.2} dB{time}", point.key) })
}
