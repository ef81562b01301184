//! The tables of the page.

use clift_data::SkipReport;
use clift_scene::TokenCoding;
use maud::{Markup, html};

use crate::report::axis::{grouped, milliseconds};
use crate::report::html::{DASH, count, number, table, text};
use crate::statistics::paired::PairedDifference;
use crate::statistics::summary::{Summary, SummaryPoint};
use crate::system::machine::machine_rows;

const POINTS_HEAD: [&str; 20] = [
    "method",
    "stored\ntokens",
    "rendered\ntokens",
    "format\n\u{a0}",
    "PSNR\ndB",
    "\u{b1}\ndB",
    "SSIM\n\u{a0}",
    "LPIPS\n\u{a0}",
    "sharp-\nness",
    "render\nms",
    "p95\nms",
    "frame\nms",
    "half of\nframes, ms",
    "p95\nms",
    "GMAC\n\u{a0}",
    "stored\nvalues",
    "scene\nkB",
    "memory\nMB",
    "front:\ntime",
    "front:\nbytes",
];

const POINTS_NOTE: &str = "Each view is rendered in a call of its own, including the keys and values of its tokens. Frame: token \
                           selection and rendering. Times are medians, the middle half and 95th percentiles over views; the \
                           points take turns at every view, and those of equal token counts, which compute the same, share \
                           their times. A point is on the front of time if no point of a higher PSNR has a middle half that \
                           overlaps or lies below, on that of bytes if none has its PSNR in as few bytes. Memory: \
                           peak of the whole process. GMAC: multiply-accumulates per view, attention included.";

const DIFFERENCES_HEAD: [&str; 7] =
    ["better", "worse", "stored\ntokens", "format\n\u{a0}", "scenes\n\u{a0}", "difference\ndB", "\u{b1}\ndB"];

const DIFFERENCES_NOTE: &str = "PSNR of the method that the paper finds better minus PSNR of the other method, on the \
                                same scenes; negative where these scenes disagree with the paper.";

/// Returns the table of all points, baselines first, with notes on missing images and metrics.
pub fn points(summary: &Summary) -> Markup {
    let Summary { baselines, points, missing, not_measured, num_views, .. } = summary;
    let rows = html! {
        @for (name, quality) in [("nearest view", baselines.nearest_view), ("mean image", baselines.mean_image)] {
            tr {
                td {
                    (name)
                    @if quality.num_identical_views > 0 {
                        " (" (count(quality.num_identical_views)) " views identical to the target)"
                    }
                }
                td {} td {} td {}
                td { (number(quality.psnr, 2)) }
                td {}
                td { (number(quality.ssim, 3)) }
                td { (number(quality.lpips_vgg, 3)) }
                td { (number(quality.sharpness, 2)) }
                @for _ in 9..POINTS_HEAD.len() { td {} }
            }
        }
        @for (i, point) in points.iter().enumerate() {
            @let is_first = i == 0 || points[i - 1].key.method != point.key.method;
            @let is_front = point.pareto_time || point.pareto_bytes;
            tr.first[is_first].front-row[is_front] {
                td { (point.key.method.name()) }
                @for cell in cells(point) { td { (cell) } }
            }
        }
    };
    html! {
        h2 { "All points" }
        (table(Some("points"), &POINTS_HEAD, &rows))
        p.note { (POINTS_NOTE) }
        @for missing in missing {
            p.note {
                (missing.method.name()) ": " (missing.num_missing) " of " (num_views)
                " images are missing; the means are over the others."
            }
        }
        @for missing in not_measured {
            p.note { code { (missing.metric) } " is not measured: " (text(&missing.reason)) }
        }
    }
}

/// Returns the cells of a point after the method.
fn cells(point: &SummaryPoint) -> [String; 19] {
    let tokens = |tokens: usize| if tokens == 0 { DASH.to_owned() } else { count(tokens) };
    let ms = |seconds: Option<f64>| seconds.map_or_else(|| DASH.into(), milliseconds);
    let dot = |is_front: bool| if is_front { "\u{25cf}".to_owned() } else { String::new() };
    [
        tokens(point.key.num_storage_tokens),
        tokens(point.key.num_render_tokens),
        storage_name(point.key.tokens),
        number(point.quality.psnr, 2),
        number(point.psnr_stderr, 2),
        number(point.quality.ssim, 3),
        number(point.quality.lpips_vgg, 3),
        number(point.quality.sharpness, 2),
        ms(point.render_median_s),
        ms(point.render_p95_s),
        ms(point.frame_median_s),
        point
            .frame_quartiles_s
            .map_or_else(|| DASH.into(), |[low, high]| format!("{} .. {}", milliseconds(low), milliseconds(high))),
        ms(point.frame_p95_s),
        number(point.cost.gflops, point.cost.gflops_decimals()),
        point.cost.scene_values.map_or_else(|| DASH.to_owned(), |values| count(values as usize)),
        number(point.cost.scene_kb(), 1),
        number(point.cost.peak_bytes.map(|bytes| bytes as f64 / 1e6), 0),
        dot(point.pareto_time),
        dot(point.pareto_bytes),
    ]
}

/// Returns the table of paired differences; nothing without pairs.
pub fn differences(differences: &[PairedDifference]) -> Markup {
    let rows = html! {
        @for row in differences {
            tr {
                td { (row.method.name()) }
                td { (row.against.name()) }
                td { (count(row.num_storage_tokens)) }
                td { (storage_name(row.tokens)) }
                td { (count(row.num_scenes)) }
                td { (grouped(row.psnr, 2)) }
                td { (number(row.psnr_stderr, 2)) }
            }
        }
    };
    html! {
        @if !differences.is_empty() {
            h2 { "Differences between methods" }
            p.note { (DIFFERENCES_NOTE) }
            (table(None, &DIFFERENCES_HEAD, &rows))
        }
    }
}

/// Returns the number of evaluated scenes, and the reasons of the skipped scenes.
pub fn skipped(num_evaluated: usize, skip_report: &SkipReport) -> Markup {
    let rows = html! { @for (reason, count) in skip_report.counts() { tr { td { (count) } td { (text(reason)) } } } };
    html! {
        h2 { "Skipped scenes" }
        p { (count(num_evaluated)) " of " (count(skip_report.num_scenes)) " scenes were evaluated." }
        @if skip_report.skips.is_empty() {
            p { "No scene was skipped." }
        } @else {
            (table(Some("plain"), &["scenes", "reason"], &rows))
            p.note { "All names: " code { "skipped.json" } "." }
        }
    }
}

/// Returns the table of command line, program version, device and machine.
pub fn machine(device: &str, command: &str) -> Markup {
    let version = env!("CARGO_PKG_VERSION").to_owned();
    let program = [("command", command.to_owned()), ("clift", version), ("device", device.to_owned())];
    let rows = program.into_iter().chain(machine_rows());
    let rows = html! { @for (name, value) in rows { tr { td { (name) } td { (value) } } } };
    html! {
        h2 { "Command and machine" }
        (table(Some("plain"), &[], &rows))
    }
}

fn storage_name(tokens: Option<TokenCoding>) -> String {
    tokens.map_or_else(|| DASH.to_owned(), |tokens| tokens.to_string())
}
