//! An evaluation as one HTML file that needs nothing beside it: no network, no scripts, no other files.

use std::io;
use std::path::Path;

use clift_data::{SkipReport, replace_file};
use maud::{DOCTYPE, Markup, PreEscaped, html};

use crate::error::EvalError;
use crate::figures::scene_figure::SceneFigure;
use crate::report::axis::{grouped, milliseconds};
use crate::report::html::{count, number};
use crate::report::plots::{Figure, figures};
use crate::report::{date, scene_section, tables};
use crate::statistics::summary::{Summary, SummaryPoint};
use crate::statistics::view_metrics::best_variant;

const STYLE: &str = include_str!("style.css");

/// Most scenes that are shown, which bounds the size of the file.
pub const MAX_EXHIBITS: usize = 6;

const SCENES_NOTE: &str = "The target view in the middle of each scene, as every variant draws it. In the maps a patch \
                           of the context views has the colour of its cluster, and rings are the centroids: the tokens \
                           that are stored.";

const CHOICE: &str = "Where views are drawn from fewer tokens than are stored, dots are those chosen for the target and \
                      rings the other stored ones.";

const FOOTNOTE: &str = "PSNR is of pictures clamped to [0, 1]; SSIM has a Gaussian window of 11 taps; LPIPS is version \
                        0.1 with VGG-16. Means are over the views of a scene, then over scenes; \u{b1} is the standard \
                        error over scenes. A dash is what was not measured. Times are of this machine, under whatever \
                        else it did.";

/// What a report is made of.
#[derive(Clone, Debug)]
pub struct Report {
    /// What was evaluated, such as the name of a run.
    pub name: String,
    /// The measured means.
    pub summary: Summary,
    /// What was left out.
    pub ledger: SkipReport,
    /// Scenes to show; the first [`MAX_EXHIBITS`] are.
    pub exhibits: Vec<SceneFigure>,
    /// The resolved config, TOML.
    pub config: String,
    /// Where tensors lived.
    pub device: String,
}

impl Report {
    /// Writes the file, under a temporary name first.
    ///
    /// # Errors
    /// [`EvalError::Io`] when the folder is missing or cannot be written.
    pub fn write(&self, path: &Path) -> Result<(), EvalError> {
        self.to_html().and_then(|html| replace_file(path, html.as_bytes())).map_err(|source| EvalError::Io {
            action: "writing the report",
            source,
            path: path.to_owned(),
        })
    }

    /// Returns the page.
    ///
    /// # Errors
    /// As [`crate::figures::canvas::Canvas::png`].
    pub fn to_html(&self) -> io::Result<String> {
        let page = html! {
            (DOCTYPE)
            html lang="en" {
                head {
                    meta charset="utf-8";
                    meta name="viewport" content="width=device-width, initial-scale=1";
                    title { (self.name) " \u{b7} clift evaluation" }
                    style { (PreEscaped(STYLE)) }
                }
                body {
                    main {
                        h1 { (self.name) }
                        p.soft { "clift evaluation, " (date::now()) }
                        (self.headline())
                        (self.quality_and_cost())
                        (tables::points(&self.summary))
                        (tables::differences(&self.summary.differences))
                        (self.scenes()?)
                        (tables::left_out(self.summary.num_scenes, &self.ledger))
                        (tables::machine(&self.device))
                        h2 { "Config" }
                        details { summary { "Every key, resolved" } pre { (self.config) } }
                        footer { p { (FOOTNOTE) } }
                    }
                }
            }
        };
        // HTML cannot express other control characters.
        Ok(page.into_string().replace(|c: char| c.is_control() && !matches!(c, '\n' | '\t'), "\u{fffd}"))
    }

    /// Returns what one wants to know first.
    fn headline(&self) -> Markup {
        let Summary { num_scenes, num_views, baselines, points, .. } = &self.summary;
        let best = best_variant(points.iter().map(SummaryPoint::key));
        let mut whole: Vec<&SummaryPoint> =
            points.iter().filter(|p| Some(p.variant) == best && p.key().is_whole()).collect();
        // Of the finest format, where there are several.
        let format = whole.iter().map(|point| point.tokens).min().flatten();
        whole.retain(|point| point.tokens == format);
        let (first, last) = (whole.first(), whole.last());
        let tokens = |point: &SummaryPoint| format!("{} tokens", count(point.num_storage_tokens));
        let nearest = baselines.nearest_view.psnr;
        html! {
            @if let (Some(first), Some(last)) = (first, last) {
                p.lead {
                    (first.variant.name()) " reaches " (reached(first))
                    @if first != last { " and " (reached(last)) }
                    "."
                    @if let Some(gain) = last.psnr.zip(nearest).map(|(psnr, nearest)| psnr - nearest) {
                        " With the latter it is " (grouped(gain.abs(), 2)) " dB "
                        (if gain < 0.0 { "below" } else { "above" }) " a copy of the nearest context view."
                    }
                }
            }
            dl.tiles {
                @for point in first.into_iter().chain(last.filter(|_| whole.len() > 1)) {
                    @let error = point.psnr_stderr.map(|error| format!("\u{b1} {error:.2}")).unwrap_or_default();
                    (tile(&format!("{}, {}", point.variant.name(), tokens(point)), &number(point.psnr, 2), "dB", &error))
                }
                (tile("nearest view", &number(nearest, 2), "dB", "a copy, no model"))
                @if let Some((point, bytes)) = first.and_then(|point| Some((point, point.scene_bytes?))) {
                    (tile("a scene file", &grouped(bytes as f64 / 1e3, 1), "kB", &tokens(point)))
                }
                @if let Some((point, seconds)) = last.and_then(|point| Some((point, point.frame_median_s?))) {
                    (tile("a frame", &milliseconds(seconds), "ms", &tokens(point)))
                }
                @let scenes = format!("of {}", count(self.ledger.num_scenes.max(*num_scenes)));
                (tile("scenes evaluated", &count(*num_scenes), &scenes, &format!("{} views", count(*num_views))))
            }
        }
    }

    fn quality_and_cost(&self) -> Markup {
        let has_error = self.summary.points.iter().any(|point| point.psnr_stderr.is_some());
        html! {
            h2 { "Quality and cost" }
            div.figures {
                @for Figure { heading, plot, note } in figures(&self.summary) {
                    section {
                        h3 { (heading) }
                        (plot.to_html())
                        @if !note.is_empty() { p.note { (note) } }
                    }
                }
            }
            p.note {
                @if has_error { "Error bars are one standard error over scenes. " }
                "Rest on a mark to read its values."
            }
        }
    }

    fn scenes(&self) -> io::Result<Markup> {
        let has_choices = self.exhibits.iter().any(|exhibit| !exhibit.choices.is_empty());
        Ok(html! {
            h2 { "Scenes" }
            @if self.exhibits.is_empty() {
                p.none { "None is shown: " code { "eval.num_sheets" } " is 0." }
            } @else {
                p.note { (SCENES_NOTE) }
                p.note {
                    @if has_choices {
                        (CHOICE)
                    } @else {
                        "All views are drawn from all stored tokens. " code { "clift eval RUN --render 1/4,1/2" }
                        " draws them from fewer, chosen for each view, and shows which."
                    }
                }
            }
            @for (number, exhibit) in self.exhibits.iter().take(MAX_EXHIBITS).enumerate() {
                (scene_section::section(exhibit, number, self.summary.selection)?)
            }
        })
    }
}

fn reached(point: &SummaryPoint) -> Markup {
    html! { strong { (number(point.psnr, 2)) " dB" } " with " (count(point.num_storage_tokens)) " stored tokens" }
}

fn tile(name: &str, value: &str, unit: &str, more: &str) -> Markup {
    html! { div { dt { (name) } dd { (value) " " small { (unit) } } dd { (more) } } }
}

#[cfg(test)]
mod tests;
