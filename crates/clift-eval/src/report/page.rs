//! An evaluation as one self-contained HTML file: no network access, no scripts, no other files.

use std::path::Path;
use std::time::{SystemTime, UNIX_EPOCH};

use base64::prelude::{BASE64_STANDARD, Engine};
use clift_core::{RgbImage, plural, replace_file};
use clift_data::{SkipReport, encode_jpeg};
use maud::{DOCTYPE, Markup, PreEscaped, html};

use crate::error::EvalError;
use crate::figures::canvas::Canvas;
use crate::report::plots::plots;
use crate::statistics::summary::Summary;
use crate::statistics::table::HEADER;
use crate::system::machine::machine_rows;

const STYLE: &str = include_str!("style.css");

/// Largest number of contact sheets in a report, and the quality of their JPEGs, which bound the size of the file.
pub const MAX_FIGURES: usize = 6;
const JPEG_QUALITY: u8 = 85;

const POINTS_NOTE: &str = "Each view is rendered in a call of its own, including the keys and values of its tokens. Frame: token \
                           selection and rendering; the points take turns at every view. PSNR: images clamped to [0, 1]. SSIM: \
                           Gaussian window of 11 taps. LPIPS: version 0.1 with VGG-16. Sharp: mean gradient of the luminance \
                           over that of the target. Means are over the views of a scene, then over scenes; +- is the standard \
                           error over scenes. GMAC: multiply-accumulates per view, attention included. Times are of this \
                           machine, including other load.";

const DIFFERENCES_NOTE: &str = "PSNR of the method that the paper finds better minus PSNR of the other method, on the same \
                                scenes, with standard errors; negative where these scenes disagree with the paper.";

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
    pub skipped: SkipReport,
    /// Keys and contact sheets of scenes; the report has the first [`MAX_FIGURES`].
    pub sheets: Vec<(String, Canvas)>,
}

impl Report {
    pub fn write(&self, path: &Path) -> Result<(), EvalError> {
        let html = self.to_html()?;
        replace_file(path, html.as_bytes()).map_err(EvalError::io("writing the report", path))
    }

    fn to_html(&self) -> Result<String, EvalError> {
        let Self { run: RunDescription { name, config, .. }, summary, .. } = self;
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
                            @if let Some(split) = summary.facts.split { " \u{b7} measured on: " strong { (split) } }
                        }
                        @if let Some(note) = summary.masked_note() { p.note { (note) } }
                        @for warning in summary.warnings() { p.warning { "Warning: " (text(&warning)) } }
                        h2 { "Quality and cost" }
                        div.figures { @for plot in plots(summary) { (plot.to_html()) } }
                        p.note { "Error bars are one standard error over scenes. Hover over a mark to read its values." }
                        h2 { "All points" }
                        (table(&HEADER, summary.rows().iter().map(<[String; 16]>::as_slice)))
                        @for note in summary.notes() { p.note { (text(&note)) } }
                        p.note { (POINTS_NOTE) }
                        @if !summary.differences.is_empty() {
                            h2 { "Differences between methods" }
                            p.note { (DIFFERENCES_NOTE) }
                            pre { @for line in summary.difference_lines() { (line) "\n" } }
                        }
                        (self.scenes()?)
                        (self.skipped_scenes())
                        (self.machine())
                        h2 { "Config" }
                        details { summary { "Every key, resolved" } pre { (config) } }
                    }
                }
            }
        };
        // HTML cannot express other control characters.
        Ok(page.into_string().replace(|c: char| c.is_control() && !matches!(c, '\n' | '\t'), "\u{fffd}"))
    }

    fn scenes(&self) -> Result<Markup, EvalError> {
        let data_uri = |sheet: &Canvas| -> Result<String, EvalError> {
            let image = RgbImage { width: sheet.width(), height: sheet.height(), rgb: sheet.as_rgb8().to_vec() };
            let jpeg = encode_jpeg(&image, JPEG_QUALITY)?;
            Ok(format!("data:image/jpeg;base64,{}", BASE64_STANDARD.encode(jpeg)))
        };
        Ok(html! {
            h2 { "Images of scenes" }
            @if self.sheets.is_empty() { p.none { "No contact sheets: see " code { "eval.num_sheets" } "." } }
            @for (key, sheet) in self.sheets.iter().take(MAX_FIGURES) {
                article.scene { img alt=(format!("Contact sheet of {key}")) src=(data_uri(sheet)?); }
            }
        })
    }

    fn skipped_scenes(&self) -> Markup {
        let skipped = &self.skipped;
        let rows: Vec<_> =
            skipped.counts().into_iter().map(|(reason, count)| [count.to_string(), reason.to_owned()]).collect();
        html! {
            h2 { "Skipped scenes" }
            @if skipped.skips.is_empty() {
                p { "All scenes were evaluated: " (plural(self.summary.num_scenes, "scene")) "." }
            } @else {
                p { (self.summary.num_scenes) " of " (plural(skipped.num_scenes, "scene")) " were evaluated." }
                (table(&["scenes", "reason"], rows.iter().map(<[String; 2]>::as_slice)))
                p.note { "All names: " code { "skipped.json" } "." }
            }
        }
    }

    fn machine(&self) -> Markup {
        let RunDescription { device, command, .. } = &self.run;
        let version = env!("CARGO_PKG_VERSION").to_owned();
        let program = [("command", command.clone()), ("clift", version), ("device", device.clone())];
        let rows: Vec<[String; 2]> =
            program.into_iter().chain(machine_rows()).map(|(name, value)| [name.to_owned(), value]).collect();
        html! {
            h2 { "Command and machine" }
            (table(&["", ""], rows.iter().map(<[String; 2]>::as_slice)))
        }
    }
}

/// Returns a table that scrolls within the page.
fn table<'a>(head: &[&str], rows: impl Iterator<Item = &'a [String]>) -> Markup {
    html! {
        div.scroll {
            table {
                thead { tr { @for name in head { th scope="col" { (name) } } } }
                tbody { @for row in rows { tr { @for cell in row { td { (text(cell)) } } } } }
            }
        }
    }
}

/// Returns a text, its parts in backquotes as code.
fn text(message: &str) -> Markup {
    html! {
        @for (i, part) in message.split('`').enumerate() {
            @if i % 2 == 1 { code { (part) } } @else { (part) }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::method::Method;
    use crate::statistics::eval_results::EvalResults;
    use crate::statistics::view_metrics::{EvalKey, ViewMetrics};
    use crate::testing::f32_key as key;
    use clift_scene::TokenCoding;

    const HOSTILE: &str = "<script>alert('room')</script>";
    const ESCAPED: &str = "&lt;script&gt;alert('room')&lt;/script&gt;";

    /// Two methods at two counts and one selection, over two scenes.
    fn results() -> EvalResults {
        let mut results = EvalResults::default();
        for (scene, shift) in [("a", 0.0), ("b", 1.0)] {
            results.add(scene, 3, EvalKey::baseline(Method::NearestView), ViewMetrics::quality(15.0, Some(0.4)));
            for (key, psnr, ms) in [
                (key(Method::Clift, 4, 4), 16.0, 2.0),
                (key(Method::Clift, 8, 8), 18.0, 3.0),
                (key(Method::Clift, 8, 2), 14.5, 1.0),
                (key(Method::Random, 4, 4), 14.0, 2.5),
            ] {
                let metrics = ViewMetrics { render_s: Some(ms * 1e-3), ..ViewMetrics::quality(psnr + shift, None) };
                results.add(scene, 3, key, metrics);
                if key.method == Method::Clift {
                    results.add_scene_bytes(key, 1000 * key.num_storage_tokens as u64);
                }
            }
            results.add_coded_bytes(key(Method::Clift, 8, 8), 777);
        }
        results.note_not_measured("lpips_vgg", "no <weights>".into());
        results
    }

    fn page(results: &EvalResults, num_sheets: usize) -> String {
        let mut skipped = SkipReport::new(3);
        if num_sheets > 0 {
            skipped.skip("c", format!("bad frame {HOSTILE}"));
        }
        // Noise, which compresses badly, and the counts of the paper's main experiment.
        let noise: Vec<u8> = (0..1600_u32 * 1400 * 3).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect();
        let sheet = Canvas::from_rgb8(&noise, 1400, 1600).unwrap();
        let report = Report {
            run: RunDescription {
                name: format!("run\u{7} {HOSTILE}"),
                config: format!("data.root = \"{HOSTILE}\""),
                device: "flex".into(),
                command: format!("clift eval {HOSTILE}"),
            },
            summary: Summary::new(results),
            skipped,
            sheets: vec![(HOSTILE.into(), sheet); num_sheets],
        };
        report.to_html().unwrap()
    }

    #[test]
    fn pages_have_all_sections_and_no_external_resources() {
        let html = page(&results(), 8);
        for part in [
            "Quality against stored tokens",
            "Quality against the size of a scene",
            "clift, coded: the default of clift encode",
            "<td>0.8</td>",
            "Quality against rendered tokens",
            "Quality against time per frame",
            "2 of 3 scenes were evaluated",
            "clift eval ",
            env!("CARGO_PKG_VERSION"),
            "<h1>run\u{fffd} &lt;script",
            "lpips_vgg is not measured: no &lt;weights&gt;",
        ] {
            assert!(html.contains(part), "{part} is missing");
        }
        let text = html.split("base64,").enumerate();
        let text: String = text.map(|(i, part)| if i == 0 { part } else { part.split_once('"').unwrap().1 }).collect();
        for outside in ["http", "<script", "<link", "@import", "url(", "NaN", "inf\""] {
            assert!(!text.contains(outside), "{outside}");
        }
        assert_eq!(html.matches("src=\"").count(), html.matches("src=\"data:image/jpeg;base64,").count());
        assert_eq!(html.matches("Contact sheet of ").count(), MAX_FIGURES);
        assert_eq!(html.matches(HOSTILE).count(), 0);
        // Title, heading, sheets, skip reason, command and config.
        assert_eq!(html.matches(ESCAPED).count(), 5 + MAX_FIGURES);
        assert!(html.len() < 30_000_000, "{} bytes of noise", html.len());
    }

    #[test]
    fn gaps_are_explained_and_several_formats_have_lines_of_their_own() {
        let empty = page(&EvalResults::default(), 0);
        for part in ["No measured points", "eval.num_sheets", "All scenes were evaluated: 0 scenes"] {
            assert!(empty.contains(part), "{part}");
        }
        let mut several = results();
        assert!(!page(&several, 0).contains("clift, f32"), "a single format is not named");
        let f16 = EvalKey { tokens: Some(TokenCoding::F16), ..key(Method::Clift, 8, 8) };
        several.add("a", 3, f16, ViewMetrics::quality(17.5, None));
        several.add_scene_bytes(f16, 2000);
        let html = page(&several, 0);
        for part in ["</svg>clift, f32</li>", "</svg>clift, f16</li>", "</svg>random</li>", "<td>f16</td>"] {
            assert!(html.contains(part), "{part}");
        }
    }
}
