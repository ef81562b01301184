//! An evaluation as one self-contained HTML file: no network access, no scripts, no other files.

use std::io;
use std::path::Path;
use std::time::{SystemTime, UNIX_EPOCH};

use clift_core::replace_file;
use clift_data::SkipReport;
use maud::{DOCTYPE, Markup, PreEscaped, html};

use crate::error::EvalError;
use crate::figures::scene_figure::SceneFigure;
use crate::report::html::text;
use crate::report::plots::plots;
use crate::report::training::{self, TrainingCurve};
use crate::report::{scene_section, tables};
use crate::statistics::summary::Summary;

const STYLE: &str = include_str!("style.css");

/// Largest number of scenes in a report, which bounds the size of the file.
pub const MAX_FIGURES: usize = 6;

const SCENES_NOTE: &str = "The middle target view of each scene, rendered by every method. In the maps, a patch of the \
                           context views has the colour of its cluster; rings mark the centroids, which are the \
                           stored tokens. Error maps: the mean absolute difference of the channels, brightest from 0.25 on.";

const SELECTION_NOTE: &str = "For views rendered from fewer tokens than stored, dots mark the tokens selected for the \
                              target and rings mark the other stored tokens.";

const FOOTNOTE: &str = "PSNR: images clamped to [0, 1]. SSIM: Gaussian window of 11 taps. LPIPS: version 0.1 with \
                        VGG-16. Sharpness: mean gradient of the luminance over that of the target. Means are over \
                        the views of a scene, then over scenes; \u{b1} is the standard error over scenes. A dash: not \
                        measured. Times are of this machine, including other load.";

/// Description of the evaluated run for the report.
#[derive(Clone, Debug)]
pub struct RunDescription {
    /// Name of the run.
    pub name: String,
    /// The config of the run, as TOML.
    pub config: String,
    /// Name of the device.
    pub device: String,
    /// The command line.
    pub command: String,
}

#[derive(Clone, Debug)]
pub struct Report {
    pub run: RunDescription,
    pub summary: Summary,
    /// Training curves of the run, by stage; may be empty.
    pub training: Vec<TrainingCurve>,
    /// Skipped scenes with their reasons.
    pub skipped: SkipReport,
    /// Figures of scenes; the report has the first [`MAX_FIGURES`].
    pub figures: Vec<SceneFigure>,
}

impl Report {
    pub fn write(&self, path: &Path) -> Result<(), EvalError> {
        self.to_html()
            .and_then(|html| replace_file(path, html.as_bytes()))
            .map_err(EvalError::io("writing the report", path))
    }

    pub fn to_html(&self) -> io::Result<String> {
        let RunDescription { name, config, device, command } = &self.run;
        let page = html! {
            (DOCTYPE)
            html lang="en" {
                head {
                    meta charset="utf-8";
                    meta name="viewport" content="width=device-width, initial-scale=1";
                    title { (name) " \u{b7} clift evaluation" }
                    style { (PreEscaped(STYLE)) }
                }
                body {
                    main {
                        h1 { (name) }
                        p.soft {
                            "clift evaluation, " (httpdate::fmt_http_date(SystemTime::now().max(UNIX_EPOCH)))
                            @if let Some(split) = self.summary.split { " \u{b7} measured on: " strong { (split) } }
                        }
                        @if let Some(note) = self.summary.masked_note() { p.note { (note) } }
                        @for warning in self.summary.warnings() { p.warning { "Warning: " (text(&warning)) } }
                        (self.quality_and_cost())
                        (tables::points(&self.summary))
                        (tables::differences(&self.summary.differences))
                        (self.figures()?)
                        (training::section(&self.training))
                        (tables::skipped(self.summary.num_scenes, &self.skipped))
                        (tables::machine(device, command))
                        h2 { "Config" }
                        details { summary { "Every key, resolved" } pre { (config) } }
                        footer { p { (FOOTNOTE) } }
                    }
                }
            }
        };
        // HTML cannot express other control characters.
        Ok(page.into_string().replace(|c: char| c.is_control() && !matches!(c, '\n' | '\t'), "\u{fffd}"))
    }

    fn quality_and_cost(&self) -> Markup {
        let has_error = self.summary.points.iter().any(|point| point.psnr_stderr.is_some());
        html! {
            h2 { "Quality and cost" }
            div.figures {
                @for plot in plots(&self.summary) {
                    section {
                        h3 { (plot.heading) }
                        (plot.to_html())
                        @if !plot.note.is_empty() { p.note { (plot.note) } }
                    }
                }
            }
            p.note {
                @if has_error { "Error bars are one standard error over scenes. " }
                "Hover over a mark to read its values."
            }
        }
    }

    fn figures(&self) -> io::Result<Markup> {
        let has_selections = self.figures.iter().any(|figure| !figure.selections.is_empty());
        Ok(html! {
            h2 { "Images of scenes" }
            @if self.figures.is_empty() {
                p.none { "No figures: " code { "eval.num_sheets" } " is 0." }
            } @else {
                p.note { (SCENES_NOTE) }
                p.note {
                    @if has_selections {
                        (SELECTION_NOTE)
                    } @else {
                        "All views are rendered from all stored tokens. " code { "clift eval RUN --render 1/4,1/2" }
                        " renders views from fewer tokens, selected for each view, and marks the selected tokens."
                    }
                }
            }
            @for (number, figure) in self.figures.iter().take(MAX_FIGURES).enumerate() {
                (scene_section::section(figure, number, self.summary.selection)?)
            }
        })
    }
}

#[cfg(test)]
mod tests;
