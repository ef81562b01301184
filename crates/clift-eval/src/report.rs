//! An evaluation as one HTML file that needs nothing beside it: no network, no scripts, no other files.

mod axis;
mod date;
mod figures;
mod markup;
mod plot;
mod scene;

use std::io::{self, Write};
use std::path::Path;

use clift_data::Ledger;
use clift_data::files::replace;

use crate::EvalError;
use crate::exhibit::{Exhibit, best_variant};
use crate::machine;
use crate::paired::Difference;
use crate::summary::{Point, Summary};
use axis::{grouped, milliseconds};
use clift_model::TokenStorage;
use figures::{Figure, figures, is_whole, seconds, setting};
use markup::Escaped;

const STYLE: &str = include_str!("report/style.css");

/// Most scenes that are shown, which bounds the size of the file.
pub const MAX_EXHIBITS: usize = 6;

/// What a report is made of.
#[derive(Clone, Debug)]
pub struct Report {
    /// What was evaluated, such as the name of a run.
    pub name: String,
    /// The measured means.
    pub summary: Summary,
    /// What was left out.
    pub ledger: Ledger,
    /// Scenes to show; the first [`MAX_EXHIBITS`] are.
    pub exhibits: Vec<Exhibit>,
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
        self.to_html().and_then(|html| replace(path, &html)).map_err(|source| EvalError::Io {
            action: "writing the report",
            source,
            path: path.to_owned(),
        })
    }

    /// The page, as UTF-8.
    ///
    /// # Errors
    /// As [`crate::picture::Picture::png`].
    pub fn to_html(&self) -> io::Result<Vec<u8>> {
        let mut out = Vec::new();
        let name = Escaped(&self.name);
        writeln!(out, "<!DOCTYPE html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">")?;
        writeln!(out, "<meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">")?;
        writeln!(out, "<title>{name} \u{b7} clift evaluation</title>\n<style>\n{STYLE}</style></head>\n<body><main>")?;
        writeln!(out, "<h1>{name}</h1><p class=\"soft\">clift evaluation, {}</p>", date::now())?;
        self.write_headline(&mut out)?;
        self.write_figures(&mut out)?;
        self.write_table(&mut out)?;
        self.write_differences(&mut out)?;
        self.write_adaptive(&mut out)?;
        self.write_scenes(&mut out)?;
        self.write_left_out(&mut out)?;
        self.write_machine(&mut out)?;
        self.write_config(&mut out)?;
        writeln!(out, "<footer><p>{FOOTNOTE}</p></footer>\n</main></body></html>")?;
        Ok(out)
    }

    /// What one wants to know first.
    fn write_headline(&self, out: &mut impl Write) -> io::Result<()> {
        let Summary { num_scenes, num_views, baselines, points, .. } = &self.summary;
        let best = best_variant(points.iter().map(setting));
        let mut whole: Vec<&Point> = points.iter().filter(|p| Some(p.variant) == best && is_whole(p)).collect();
        // Of the finest format, where there are several.
        let format = whole.iter().map(|point| point.tokens).min().flatten();
        whole.retain(|point| point.tokens == format);
        if let (Some(fewest), Some(most)) = (whole.first(), whole.last()) {
            write!(out, "<p class=\"lead\">{}", sentence(fewest, most))?;
            if let (Some(psnr), Some(nearest)) = (most.psnr, baselines.nearest_view.psnr) {
                let gain = psnr - nearest;
                let side = if gain < 0.0 { "below" } else { "above" };
                write!(
                    out,
                    " With the latter it is {} dB {side} a copy of the nearest context view.",
                    grouped(gain.abs(), 2)
                )?;
            }
            writeln!(out, "</p>")?;
        }
        writeln!(out, "<dl class=\"tiles\">")?;
        let mut tile = |name: &str, value: String, unit: &str, more: String| {
            writeln!(out, "<div><dt>{name}</dt><dd>{value} <small>{unit}</small></dd><dd>{more}</dd></div>")
        };
        let (first, last) = (whole.first(), whole.last().filter(|_| whole.len() > 1));
        for point in first.into_iter().chain(last) {
            let name = format!("{}, {} tokens", point.variant.name(), grouped(point.num_storage_tokens as f64, 0));
            let error = point.psnr_stderr.map(|error| format!("\u{b1} {error:.2}")).unwrap_or_default();
            tile(&name, number(point.psnr, 2), "dB", error)?;
        }
        tile("nearest view", number(baselines.nearest_view.psnr, 2), "dB", "a copy, no model".into())?;
        if let Some(bytes) = whole.first().and_then(|point| point.scene_bytes) {
            let tokens = format!("{} tokens", grouped(whole[0].num_storage_tokens as f64, 0));
            tile("a scene file", grouped(bytes as f64 / 1e3, 1), "kB", tokens)?;
        }
        if let Some((point, seconds)) = whole.last().and_then(|point| Some((point, seconds(point)?))) {
            let tokens = format!("{} tokens", grouped(point.num_storage_tokens as f64, 0));
            tile("a frame", milliseconds(seconds), "ms", tokens)?;
        }
        let scenes = format!("of {}", grouped(self.ledger.num_scenes.max(*num_scenes) as f64, 0));
        let views = format!("{} views", grouped(*num_views as f64, 0));
        tile("scenes evaluated", grouped(*num_scenes as f64, 0), &scenes, views)?;
        writeln!(out, "</dl>")
    }

    fn write_figures(&self, out: &mut impl Write) -> io::Result<()> {
        writeln!(out, "<h2>Quality and cost</h2>\n<div class=\"figures\">")?;
        for Figure { heading, plot, note } in figures(&self.summary) {
            writeln!(out, "<section><h3>{heading}</h3>")?;
            plot.write(out)?;
            if !note.is_empty() {
                writeln!(out, "<p class=\"note\">{note}</p>")?;
            }
            writeln!(out, "</section>")?;
        }
        writeln!(out, "</div>")?;
        let has_error = self.summary.points.iter().any(|point| point.psnr_stderr.is_some());
        let error = if has_error { "Error bars are one standard error over scenes." } else { "" };
        writeln!(out, "<p class=\"note\">{error} Rest on a mark to read its values.</p>")
    }

    fn write_table(&self, out: &mut impl Write) -> io::Result<()> {
        let Summary { baselines, points, .. } = &self.summary;
        writeln!(out, "<h2>All points</h2>\n<div class=\"scroll\"><table class=\"points\"><thead><tr>")?;
        for head in TABLE_HEAD {
            write!(out, "<th scope=\"col\">{head}</th>")?;
        }
        writeln!(out, "</tr></thead><tbody>")?;
        for (name, quality) in [("nearest view", baselines.nearest_view), ("mean image", baselines.mean_image)] {
            let (psnr, ssim, lpips) = (number(quality.psnr, 2), number(quality.ssim, 3), number(quality.lpips_vgg, 3));
            write!(out, "<tr><td>{name}</td><td></td><td></td><td></td><td>{psnr}</td><td></td><td>{ssim}</td>")?;
            writeln!(out, "<td>{lpips}</td>{}</tr>", "<td></td>".repeat(TABLE_HEAD.len() - 8))?;
        }
        for (i, point) in points.iter().enumerate() {
            let is_first = i == 0 || points[i - 1].variant != point.variant;
            let is_front = point.pareto_time || point.pareto_bytes;
            let class = [is_first.then_some("first"), is_front.then_some("front-row")];
            let class: Vec<&str> = class.into_iter().flatten().collect();
            write!(out, "<tr class=\"{}\"><td>{}</td>", class.join(" "), Escaped(point.variant.name()))?;
            for cell in cells(point) {
                write!(out, "<td>{cell}</td>")?;
            }
            writeln!(out, "</tr>")?;
        }
        writeln!(out, "</tbody></table></div>\n<p class=\"note\">{TABLE_NOTE}</p>")?;
        for missing in &self.summary.missing {
            let (name, count) = (Escaped(missing.variant.name()), missing.num_missing);
            let of = self.summary.num_views;
            writeln!(
                out,
                "<p class=\"note\">{name}: {count} of {of} pictures are missing; its means are over the rest.</p>"
            )?;
        }
        for missing in &self.summary.not_measured {
            let (metric, reason) = (Escaped(&missing.metric), Escaped(&missing.reason));
            writeln!(out, "<p class=\"note\"><code>{metric}</code> is not measured: {reason}</p>")?;
        }
        Ok(())
    }

    /// Which variant is better on the same scenes; nothing where there is no pair.
    fn write_differences(&self, out: &mut impl Write) -> io::Result<()> {
        let differences = &self.summary.differences;
        if differences.is_empty() {
            return Ok(());
        }
        writeln!(out, "<h2>Scene by scene</h2>\n<p class=\"note\">{DIFFERENCES_NOTE}</p>")?;
        writeln!(out, "<div class=\"scroll\"><table><thead><tr>")?;
        for head in [
            "better",
            "worse",
            "stored<br>tokens",
            "format<br>&nbsp;",
            "scenes<br>&nbsp;",
            "difference<br>dB",
            "\u{b1}<br>dB",
        ] {
            write!(out, "<th scope=\"col\">{head}</th>")?;
        }
        writeln!(out, "</tr></thead><tbody>")?;
        for Difference { variant, against, num_storage_tokens, num_scenes, tokens, psnr, psnr_stderr } in differences {
            let count = grouped(*num_storage_tokens as f64, 0);
            let (psnr, error) = (number(Some(*psnr), 2), number(*psnr_stderr, 2));
            let format = tokens.map_or(DASH, TokenStorage::name);
            write!(out, "<tr><td>{}</td><td>{}</td>", variant.name(), against.name())?;
            write!(out, "<td>{count}</td><td>{format}</td>")?;
            writeln!(out, "<td>{}</td><td>{psnr}</td><td>{error}</td></tr>", grouped(*num_scenes as f64, 0))?;
        }
        writeln!(out, "</tbody></table></div>")
    }

    /// What a count for every scene gains over one for all; nothing where there are not three counts.
    fn write_adaptive(&self, out: &mut impl Write) -> io::Result<()> {
        let adaptive = &self.summary.adaptive;
        if adaptive.is_empty() {
            return Ok(());
        }
        writeln!(out, "<h2>A count for every scene</h2>\n<p class=\"note\">{ADAPTIVE_NOTE}</p>")?;
        writeln!(out, "<div class=\"scroll\"><table><thead><tr>")?;
        let heads = [
            "most<br>error",
            "tokens,<br>mean",
            "PSNR<br>dB",
            "fixed<br>tokens",
            "difference<br>dB",
            "\u{b1}<br>dB",
            "at most<br>dB",
        ];
        for head in ["variant"].into_iter().chain(heads) {
            write!(out, "<th scope=\"col\">{head}</th>")?;
        }
        writeln!(out, "</tr></thead><tbody>")?;
        for row in adaptive {
            let cells = [
                number(Some(row.max_error), 4),
                number(Some(row.mean_storage_tokens), 1),
                number(Some(row.psnr), 2),
                grouped(row.num_storage_tokens as f64, 0),
                number(Some(row.difference), 2),
                number(row.difference_stderr, 2),
                number(Some(row.difference_bound), 2),
            ];
            write!(out, "<tr><td>{}</td>", row.variant.name())?;
            for cell in cells {
                write!(out, "<td>{cell}</td>")?;
            }
            writeln!(out, "</tr>")?;
        }
        writeln!(out, "</tbody></table></div>")
    }

    fn write_scenes(&self, out: &mut impl Write) -> io::Result<()> {
        writeln!(out, "<h2>Scenes</h2>")?;
        if self.exhibits.is_empty() {
            return writeln!(out, "<p class=\"none\">None is shown: <code>eval.num_sheets</code> is 0.</p>");
        }
        writeln!(out, "<p class=\"note\">{SCENES_NOTE}</p>")?;
        let has_choices = self.exhibits.iter().any(|exhibit| !exhibit.choices.is_empty());
        writeln!(out, "<p class=\"note\">{}</p>", if has_choices { CHOICE } else { NO_CHOICE })?;
        for (number, exhibit) in self.exhibits.iter().take(MAX_EXHIBITS).enumerate() {
            scene::write(exhibit, number, self.summary.selection, out)?;
        }
        Ok(())
    }

    fn write_left_out(&self, out: &mut impl Write) -> io::Result<()> {
        let Ledger { num_scenes, skips, .. } = &self.ledger;
        writeln!(out, "<h2>What was left out</h2>")?;
        let evaluated = grouped(self.summary.num_scenes as f64, 0);
        writeln!(out, "<p>{evaluated} of {} scenes were evaluated.</p>", grouped(*num_scenes as f64, 0))?;
        if skips.is_empty() {
            return writeln!(out, "<p>None was left out.</p>");
        }
        writeln!(out, "<table class=\"plain\"><thead><tr><th>scenes</th><th>reason</th></tr></thead><tbody>")?;
        for (reason, count) in self.ledger.counts() {
            writeln!(out, "<tr><td>{count}</td><td>{}</td></tr>", Escaped(reason))?;
        }
        writeln!(out, "</tbody></table><p class=\"note\">Each by its name: <code>skipped.json</code>.</p>")
    }

    fn write_machine(&self, out: &mut impl Write) -> io::Result<()> {
        writeln!(out, "<h2>Machine</h2><table class=\"plain\"><tbody>")?;
        let ours = [("clift", env!("CARGO_PKG_VERSION").to_owned()), ("device", self.device.clone())];
        for (name, value) in ours.into_iter().chain(machine::rows()) {
            writeln!(out, "<tr><td>{name}</td><td>{}</td></tr>", Escaped(value))?;
        }
        writeln!(out, "</tbody></table>")
    }

    fn write_config(&self, out: &mut impl Write) -> io::Result<()> {
        writeln!(out, "<h2>Config</h2><details><summary>Every key, resolved</summary>")?;
        writeln!(out, "<pre>{}</pre></details>", Escaped(&self.config))
    }
}

const TABLE_HEAD: [&str; 17] = [
    "variant",
    "stored<br>tokens",
    "rendered<br>tokens",
    "format<br>&nbsp;",
    "PSNR<br>dB",
    "\u{b1}<br>dB",
    "SSIM<br>&nbsp;",
    "LPIPS<br>&nbsp;",
    "drawing<br>ms",
    "p95<br>ms",
    "frame<br>ms",
    "p95<br>ms",
    "GMAC<br>&nbsp;",
    "scene<br>kB",
    "memory<br>MB",
    "front:<br>time",
    "front:<br>bytes",
];

const DIFFERENCES_NOTE: &str = "PSNR of the variant that the paper finds better less that of the other, on the same \
                                scenes: below zero where these scenes disagree.";

const ADAPTIVE_NOTE: &str = "Every scene keeps the fewest of the stored counts that leave at most this share of its \
                             tokens' variance within clusters, as <code>clift encode --max-error</code> does; the share \
                             is the smallest with which scenes keep no more tokens on average than the fixed count \
                             beside it. Below zero, one count for all is better. \u{201c}At most\u{201d} is what any rule \
                             could gain, had it known the PSNR of every scene at every count.";

/// What stands behind the name of a point.
fn cells(point: &Point) -> [String; 16] {
    let count = |count: usize| if count == 0 { DASH.to_owned() } else { grouped(count as f64, 0) };
    let ms = |seconds: Option<f64>| seconds.map_or_else(|| DASH.into(), milliseconds);
    let dot = |is_front: bool| if is_front { "\u{25cf}".to_owned() } else { String::new() };
    [
        count(point.num_storage_tokens),
        count(point.num_render_tokens),
        point.tokens.map_or(DASH, TokenStorage::name).to_owned(),
        number(point.psnr, 2),
        number(point.psnr_stderr, 2),
        number(point.ssim, 3),
        number(point.lpips_vgg, 3),
        ms(point.render_median_s),
        ms(point.render_p95_s),
        ms(point.frame_median_s),
        ms(point.frame_p95_s),
        number(point.gflops, if point.gflops.is_some_and(|gflops| gflops < 10.0) { 3 } else { 1 }),
        number(point.scene_bytes.map(|bytes| bytes as f64 / 1e3), 1),
        number(point.peak_bytes.map(|bytes| bytes as f64 / 1e6), 0),
        dot(point.pareto_time),
        dot(point.pareto_bytes),
    ]
}

const TABLE_NOTE: &str = "Each view is drawn alone, keys and values of its tokens included; a frame is the choice of tokens and \
                          the drawing; times are medians and 95th percentiles over views. A point is on a front if no \
                          other has its PSNR in as little time per frame, or in as few bytes. Memory is the peak of \
                          the whole process. GMAC are multiply-accumulates per view, attention included.";

const SCENES_NOTE: &str = "The target view in the middle of each scene, as every variant draws it. In the maps a patch \
                           of the context views has the colour of its cluster, and rings are the centroids: the tokens \
                           that are stored.";

const CHOICE: &str = "Where views are drawn from fewer tokens than are stored, dots are those chosen for the target and \
                      rings the other stored ones.";

const NO_CHOICE: &str = "All views are drawn from all stored tokens. <code>clift eval RUN --render 1/4,1/2</code> draws \
                         them from fewer, chosen for each view, and shows which.";

const FOOTNOTE: &str = "PSNR is of pictures clamped to [0, 1]; SSIM has a Gaussian window of 11 taps; LPIPS is \
                        version 0.1 with VGG-16. Means are over the views of a scene, then over scenes; \u{b1} is the standard error over scenes. A dash is what \
                        was not measured. Times are of this machine, under whatever else it did.";

/// What was not measured.
const DASH: &str = "\u{2013}";

/// The first sentence: what the method reaches with the fewest and with the most tokens.
fn sentence(fewest: &Point, most: &Point) -> String {
    let variant = fewest.variant.name();
    let reached = |point: &Point| {
        let tokens = grouped(point.num_storage_tokens as f64, 0);
        format!("<strong>{} dB</strong> with {tokens} stored tokens", number(point.psnr, 2))
    };
    if fewest == most {
        return format!("{variant} reaches {}.", reached(fewest));
    }
    format!("{variant} reaches {} and {}.", reached(fewest), reached(most))
}

/// A value, or a dash where it was not measured.
fn number(value: Option<f64>, decimals: usize) -> String {
    value.filter(|value| value.is_finite()).map_or_else(|| DASH.into(), |value| grouped(value, decimals))
}

#[cfg(test)]
mod tests;
