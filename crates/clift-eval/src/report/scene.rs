//! One scene of a report: its pictures, its clusters, the tokens chosen for a view.

use std::io::{self, Write};

use clift_model::SceneClusters;

use super::axis::grouped;
use super::markup::{Escaped, data_uri};
use crate::exhibit::{Choice, Drawing, Exhibit, best_variant, spread};
use crate::measured::{Setting, Variant};
use crate::picture::Picture;
use crate::selection::Selection;

/// Most token counts of a variant that are shown.
const MAX_COUNTS: usize = 4;

/// Most cluster maps of a scene, and most choices.
const MAX_MAPS: usize = 2;

/// Pictures narrower than this are magnified and shown as the pixels they are.
const SHARP_BELOW_PX: usize = 100;

/// Writes the scene; `number` tells it from the others of the page, `selection` chose the tokens of its views.
pub fn write(exhibit: &Exhibit, number: usize, selection: Option<Selection>, out: &mut impl Write) -> io::Result<()> {
    writeln!(out, "<article class=\"scene\"><h3>{}</h3>", Escaped(&exhibit.key))?;
    writeln!(out, "<div class=\"halves\"><div>")?;
    write_drawings(exhibit, out)?;
    writeln!(out, "</div><div>")?;
    write_contexts(exhibit, number, out)?;
    let is_map = |clusters: &&SceneClusters| clusters.centroid_index().len() < clusters.assignment().len();
    let maps: Vec<&SceneClusters> = exhibit.clusters.iter().filter(is_map).collect();
    for map in spread(maps.len(), MAX_MAPS) {
        write_clusters(exhibit, number, maps[map], out)?;
    }
    let best = best_variant(exhibit.choices.iter().map(|choice| choice.setting));
    let choices = exhibit.choices.iter().filter(|choice| Some(choice.setting.variant) == best);
    let most = choices.clone().map(|choice| choice.setting.num_storage_tokens).max();
    let choices: Vec<&Choice> = choices.filter(|choice| Some(choice.setting.num_storage_tokens) == most).collect();
    for choice in spread(choices.len(), MAX_MAPS) {
        write_choice(exhibit, number, choices[choice], selection, out)?;
    }
    writeln!(out, "</div></div></article>")
}

fn start_row(heading: &str, out: &mut impl Write) -> io::Result<()> {
    writeln!(out, "<div class=\"row\"><h4>{heading}</h4><div class=\"strip\">")
}

fn end_row(out: &mut impl Write) -> io::Result<()> {
    writeln!(out, "</div></div>")
}

/// The context views, which the maps below refer to by name.
fn write_contexts(exhibit: &Exhibit, number: usize, out: &mut impl Write) -> io::Result<()> {
    start_row("context views", out)?;
    for (view, (picture, frame)) in exhibit.context.iter().zip(&exhibit.context_frames).enumerate() {
        let class = sharpness(picture);
        let image = format!("id=\"s{number}v{view}\" class=\"{class}\" href=\"{}\"", data_uri(picture)?);
        write_map(
            exhibit,
            &format!("Context view, frame {frame}"),
            &format!("<image {image} {}/>", area(exhibit)),
            out,
        )?;
        writeln!(out, "<figcaption>frame {frame}</figcaption></figure>")?;
    }
    end_row(out)
}

/// Target and nearest view, then a row per variant.
fn write_drawings(exhibit: &Exhibit, out: &mut impl Write) -> io::Result<()> {
    let frame = exhibit.target_frame;
    start_row("target", out)?;
    write_picture(&exhibit.target, &format!("Target view, frame {frame}"), &format!("frame {frame}"), out)?;
    for drawing in exhibit.drawings.iter().filter(|drawing| drawing.setting.variant == Variant::NearestView) {
        write_drawing(drawing, "nearest view", out)?;
    }
    end_row(out)?;
    let whole = |setting: Setting| setting.num_render_tokens == setting.num_storage_tokens;
    for variant in [Variant::Clift, Variant::Kmeans, Variant::PatchClift, Variant::Patch, Variant::Random] {
        let drawings = exhibit.drawings.iter().filter(|d| d.setting.variant == variant && whole(d.setting));
        write_strip(variant.name(), &drawings.collect::<Vec<_>>(), out)?;
    }
    for drawing in &exhibit.drawings {
        if let Variant::System(name) = drawing.setting.variant {
            start_row(&Escaped(name.as_str()).to_string(), out)?;
            write_drawing(drawing, "its picture", out)?;
            end_row(out)?;
        }
    }
    let best = best_variant(exhibit.drawings.iter().map(|drawing| drawing.setting));
    let some = exhibit.drawings.iter().filter(|d| Some(d.setting.variant) == best && !whole(d.setting));
    let most = some.clone().map(|drawing| drawing.setting.num_storage_tokens).max();
    let some: Vec<&Drawing> = some.filter(|d| Some(d.setting.num_storage_tokens) == most).collect();
    write_strip(&format!("{}, some tokens", best.map_or("", Variant::name)), &some, out)
}

/// At most `MAX_COUNTS` drawings, by rising token counts; nothing for none.
fn write_strip(heading: &str, drawings: &[&Drawing], out: &mut impl Write) -> io::Result<()> {
    if drawings.is_empty() {
        return Ok(());
    }
    start_row(heading, out)?;
    for drawing in spread(drawings.len(), MAX_COUNTS) {
        let Setting { num_storage_tokens: stored, num_render_tokens: rendered, .. } = drawings[drawing].setting;
        let tokens = if stored == rendered { format!("{stored} tokens") } else { format!("{rendered} of {stored}") };
        write_drawing(drawings[drawing], &tokens, out)?;
    }
    end_row(out)
}

fn write_drawing(drawing: &Drawing, what: &str, out: &mut impl Write) -> io::Result<()> {
    let psnr = if drawing.psnr.is_finite() { grouped(drawing.psnr, 2) } else { "\u{221e}".into() };
    let alt = format!("The target as {} draws it, {what}, {psnr} dB", drawing.setting.variant.name().replace('_', " "));
    write_picture(&drawing.picture, &alt, &format!("{what}<br>{psnr} dB"), out)
}

fn write_picture(picture: &Picture, alt: &str, caption: &str, out: &mut impl Write) -> io::Result<()> {
    let (width, height, class) = (picture.width(), picture.height(), sharpness(picture));
    write!(out, "<figure><img class=\"{class}\" width=\"{width}\" height=\"{height}\" alt=\"{}\" ", Escaped(alt))?;
    writeln!(out, "src=\"{}\"><figcaption>{caption}</figcaption></figure>", data_uri(picture)?)
}

fn sharpness(picture: &Picture) -> &'static str {
    if picture.width() < SHARP_BELOW_PX { "sharp" } else { "smooth" }
}

/// Every patch of the context views in the colour of its cluster, centroids ringed.
fn write_clusters(exhibit: &Exhibit, number: usize, clusters: &SceneClusters, out: &mut impl Write) -> io::Result<()> {
    let [rows, columns] = exhibit.grid;
    let per_view = rows * columns;
    start_row(&format!("{} clusters", clusters.centroid_index().len()), out)?;
    for (view, assignment) in clusters.assignment().chunks(per_view).enumerate().take(exhibit.context.len()) {
        let mut tint = Picture::new(columns, rows, [0; 3]);
        for (patch, &cluster) in assignment.iter().enumerate() {
            tint.paste(&Picture::new(1, 1, cluster_colour(cluster)), patch % columns, patch / columns);
        }
        let rings = rings(clusters.centroid_index(), view, exhibit.grid, 0.3);
        let count = clusters.centroid_index().iter().filter(|&&token| token as usize / per_view == view).count();
        let content = format!(
            "<use class=\"grey\" href=\"#s{number}v{view}\"/><image class=\"tint\" href=\"{}\" {}/>\
             <path class=\"ring\" d=\"{rings}\"/>",
            data_uri(&tint)?,
            area(exhibit),
        );
        let frame = exhibit.context_frames[view];
        write_map(exhibit, &format!("Clusters over the context view of frame {frame}"), &content, out)?;
        writeln!(out, "<figcaption>frame {frame}<br>{count} centroids</figcaption></figure>")?;
    }
    end_row(out)
}

/// Which tokens the target is drawn from: dots for them, rings for the other stored ones.
fn write_choice(
    exhibit: &Exhibit,
    number: usize,
    choice: &Choice,
    selection: Option<Selection>,
    out: &mut impl Write,
) -> io::Result<()> {
    let [rows, columns] = exhibit.grid;
    let Setting { num_storage_tokens: stored, num_render_tokens: rendered, .. } = choice.setting;
    let others: Vec<u32> = choice.stored.iter().copied().filter(|id| !choice.chosen.contains(id)).collect();
    let by = selection.map_or_else(String::new, |selection| format!(" by {selection}"));
    start_row(&format!("{rendered} of {stored} tokens chosen for the target{by}"), out)?;
    for view in 0..exhibit.context.len() {
        let count = choice.chosen.iter().filter(|&&token| token as usize / (rows * columns) == view).count();
        let content = format!(
            "<use class=\"dim\" href=\"#s{number}v{view}\"/><path class=\"stored\" d=\"{}\"/>\
             <path class=\"chosen\" d=\"{}\"/>",
            rings(&others, view, exhibit.grid, 0.22),
            rings(&choice.chosen, view, exhibit.grid, 0.34),
        );
        let frame = exhibit.context_frames[view];
        write_map(exhibit, &format!("Chosen tokens over the context view of frame {frame}"), &content, out)?;
        writeln!(out, "<figcaption>frame {frame}<br>{count} chosen</figcaption></figure>")?;
    }
    end_row(out)
}

/// A picture in units of patches; the figure is left open for its caption.
fn write_map(exhibit: &Exhibit, label: &str, content: &str, out: &mut impl Write) -> io::Result<()> {
    let [rows, columns] = exhibit.grid;
    write!(out, "<figure><svg viewBox=\"0 0 {columns} {rows}\" role=\"img\" aria-label=\"{}\">", Escaped(label))?;
    writeln!(out, "{content}</svg>")
}

/// Where a picture lies that fills a view.
fn area(exhibit: &Exhibit) -> String {
    let [rows, columns] = exhibit.grid;
    format!("width=\"{columns}\" height=\"{rows}\" preserveAspectRatio=\"none\"")
}

/// A path of circles around the centres of the patches of one view.
fn rings(ids: &[u32], view: usize, [rows, columns]: [usize; 2], radius: f64) -> String {
    let across = 2.0 * radius;
    let ring = |id: usize| {
        let (x, y) = ((id % columns) as f64 + 0.5 - radius, (id / columns % rows) as f64 + 0.5);
        format!("M{x:.2} {y}a{radius} {radius} 0 1 0 {across} 0a{radius} {radius} 0 1 0 -{across} 0z")
    };
    let ids = ids.iter().map(|&id| id as usize).filter(|id| id / (rows * columns) == view);
    ids.map(ring).collect::<Vec<_>>().concat()
}

/// Colours that differ as much as may be for clusters of near numbers: hues a golden section apart.
fn cluster_colour(cluster: u32) -> [u8; 3] {
    const GOLDEN: f64 = 0.618_033_988_75;
    let hue = (f64::from(cluster) * GOLDEN).fract() * 6.0;
    // Three levels of lightness, so that hues that come near again differ too.
    let light = [0.5, 0.62, 0.38][cluster as usize % 3];
    let chroma = 0.85 * (1.0 - (2.0 * light - 1.0_f64).abs());
    [0.0, 4.0, 2.0].map(|shift| {
        let part = ((hue + shift) % 6.0 - 3.0).abs() - 1.0;
        ((light + chroma * (part.clamp(0.0, 1.0) - 0.5)) * 255.0).round() as u8
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rings_stand_on_the_patches_of_their_view() {
        // Views of 2 x 3 patches: id 6 is the first patch of the second view, 11 its last.
        let path = rings(&[1, 6, 11], 1, [2, 3], 0.25);
        let starts: Vec<&str> = path.split('M').skip(1).map(|ring| ring.split('a').next().unwrap()).collect();
        assert_eq!(starts, ["0.25 0.5", "2.25 1.5"]);
        assert_eq!(rings(&[1], 1, [2, 3], 0.25), "");
    }

    #[test]
    fn clusters_of_near_numbers_have_colours_far_apart() {
        let colours: Vec<[u8; 3]> = (0..64).map(cluster_colour).collect();
        let difference = |a: [u8; 3], b: [u8; 3]| -> i32 {
            a.iter().zip(b).map(|(a, b)| (i32::from(*a) - i32::from(b)).abs()).sum()
        };
        for (i, &colour) in colours.iter().enumerate() {
            for &other in &colours[i + 1..(i + 4).min(64)] {
                assert!(difference(colour, other) > 60, "{colour:?} {other:?}");
            }
            assert_eq!(colours.iter().filter(|&&other| other == colour).count(), 1);
        }
    }
}
