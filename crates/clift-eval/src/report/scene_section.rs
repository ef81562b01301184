//! One scene of a report: its pictures, its clusters, the tokens chosen for a view.

use std::io;

use clift_model::SceneClusters;
use maud::{Markup, html};

use crate::config::method::Method;
use crate::config::token_selection::Selection;
use crate::figures::canvas::Canvas;
use crate::figures::scene_figure::{Drawing, FigureTokens, SceneFigure};
use crate::report::axis::grouped;
use crate::report::html::data_uri;
use crate::statistics::view_metrics::{EvalKey, best_variant};
use crate::sweep::scene_results::spread;

/// Most token counts of a variant that are shown.
const MAX_COUNTS: usize = 4;

/// Most cluster maps of a scene, and most choices.
const MAX_MAPS: usize = 2;

/// Pictures narrower than this are magnified and shown as the pixels they are.
const SHARP_BELOW_PX: usize = 100;

/// Returns the section of a scene; `number` tells it from the others of the page, `selection` chose the tokens of its
/// views.
pub fn section(exhibit: &SceneFigure, number: usize, selection: Option<Selection>) -> io::Result<Markup> {
    let is_map = |clusters: &&SceneClusters| clusters.centroid_index().len() < clusters.assignment().len();
    let maps: Vec<&SceneClusters> = exhibit.clusters.iter().filter(is_map).collect();
    let best = best_variant(exhibit.choices.iter().map(|choice| choice.setting));
    let choices = exhibit.choices.iter().filter(|choice| Some(choice.setting.variant) == best);
    let most = choices.clone().map(|choice| choice.setting.num_storage_tokens).max();
    let choices: Vec<&FigureTokens> =
        choices.filter(|choice| Some(choice.setting.num_storage_tokens) == most).collect();
    Ok(html! {
        article.scene {
            h3 { (exhibit.key) }
            div.halves {
                div { (drawings(exhibit)?) }
                div {
                    (contexts(exhibit, number)?)
                    @for map in spread(maps.len(), MAX_MAPS) { (clusters(exhibit, number, maps[map])?) }
                    @for choice in spread(choices.len(), MAX_MAPS) {
                        (chosen(exhibit, number, choices[choice], selection))
                    }
                }
            }
        }
    })
}

fn row(heading: &str, strip: Markup) -> Markup {
    html! { div.row { h4 { (heading) } div.strip { (strip) } } }
}

/// Target and nearest view, then a row per variant.
fn drawings(exhibit: &SceneFigure) -> io::Result<Markup> {
    let target_frame = exhibit.target_frame;
    let of = |variant: Method| exhibit.drawings.iter().filter(move |drawing| drawing.setting.variant == variant);
    let best = best_variant(exhibit.drawings.iter().map(|drawing| drawing.setting));
    let some = exhibit.drawings.iter().filter(|d| Some(d.setting.variant) == best && !d.setting.is_whole());
    let most = some.clone().map(|drawing| drawing.setting.num_storage_tokens).max();
    let some = some.filter(|drawing| Some(drawing.setting.num_storage_tokens) == most);
    let target = html! {
        (image(&exhibit.target, &format!("Target view, frame {target_frame}"), frame(target_frame))?)
        @for nearest in of(Method::NearestView) { (drawing(nearest, "nearest view")?) }
    };
    Ok(html! {
        (row("target", target))
        @for variant in [Method::Clift, Method::Kmeans, Method::PatchClift, Method::Patch, Method::Random] {
            (strip(variant.name(), &of(variant).filter(|drawing| drawing.setting.is_whole()).collect::<Vec<_>>())?)
        }
        @for other in &exhibit.drawings {
            @if let Method::System(name) = other.setting.variant {
                (row(name.as_str(), drawing(other, "its picture")?))
            }
        }
        (strip(&format!("{}, some tokens", best.map_or("", Method::name)), &some.collect::<Vec<_>>())?)
    })
}

/// At most `MAX_COUNTS` drawings, by rising token counts; nothing for none.
fn strip(heading: &str, drawings: &[&Drawing]) -> io::Result<Markup> {
    let tokens = |EvalKey { num_storage_tokens: stored, num_render_tokens: rendered, .. }| {
        if stored == rendered { format!("{stored} tokens") } else { format!("{rendered} of {stored}") }
    };
    let shown = html! {
        @for i in spread(drawings.len(), MAX_COUNTS) { (drawing(drawings[i], &tokens(drawings[i].setting))?) }
    };
    Ok(if drawings.is_empty() { Markup::default() } else { row(heading, shown) })
}

fn drawing(drawing: &Drawing, what: &str) -> io::Result<Markup> {
    let psnr = if drawing.psnr.is_finite() { grouped(drawing.psnr, 2) } else { "\u{221e}".into() };
    let alt = format!("The target as {} draws it, {what}, {psnr} dB", drawing.setting.variant.name().replace('_', " "));
    image(&drawing.picture, &alt, html! { (what) br; (psnr) " dB" })
}

fn image(picture: &Canvas, alt: &str, caption: Markup) -> io::Result<Markup> {
    let (width, height) = (picture.width(), picture.height());
    Ok(html! {
        figure {
            img class=(sharpness(picture)) width=(width) height=(height) alt=(alt) src=(data_uri(picture)?);
            figcaption { (caption) }
        }
    })
}

fn sharpness(picture: &Canvas) -> &'static str {
    if picture.width() < SHARP_BELOW_PX { "sharp" } else { "smooth" }
}

fn frame(frame: usize) -> Markup {
    html! { "frame " (frame) }
}

/// The context views, which the maps below refer to by name.
fn contexts(exhibit: &SceneFigure, number: usize) -> io::Result<Markup> {
    let [rows, columns] = exhibit.grid;
    let strip = html! {
        @for (view, (picture, &index)) in exhibit.context.iter().zip(&exhibit.context_frames).enumerate() {
            @let content = html! {
                image id={ "s" (number) "v" (view) } class=(sharpness(picture)) href=(data_uri(picture)?)
                    width=(columns) height=(rows) preserveAspectRatio="none" {}
            };
            (map(exhibit, &format!("Context view, frame {index}"), content, frame(index)))
        }
    };
    Ok(row("context views", strip))
}

/// Every patch of the context views in the colour of its cluster, centroids ringed.
fn clusters(exhibit: &SceneFigure, number: usize, clusters: &SceneClusters) -> io::Result<Markup> {
    let [rows, columns] = exhibit.grid;
    let (per_view, centroids) = (rows * columns, clusters.centroid_index());
    let tint = |assignment: &[u32]| {
        let mut tint = Canvas::new(columns, rows, [0; 3]);
        for (patch, &cluster) in assignment.iter().enumerate() {
            tint.paste(&Canvas::new(1, 1, cluster_colour(cluster)), patch % columns, patch / columns);
        }
        data_uri(&tint)
    };
    let strip = html! {
        @for (view, (assignment, index)) in
            clusters.assignment().chunks(per_view).zip(&exhibit.context_frames).enumerate()
        {
            @let content = html! {
                use.grey href={ "#s" (number) "v" (view) } {}
                image.tint href=(tint(assignment)?) width=(columns) height=(rows) preserveAspectRatio="none" {}
                path.ring d=(rings(centroids, view, exhibit.grid, 0.3)) {}
            };
            @let caption = html! { "frame " (index) br; (num_in_view(centroids, view, per_view)) " centroids" };
            (map(exhibit, &format!("Clusters over the context view of frame {index}"), content, caption))
        }
    };
    Ok(row(&format!("{} clusters", centroids.len()), strip))
}

/// Which tokens the target is drawn from: dots for them, rings for the other stored ones.
fn chosen(exhibit: &SceneFigure, number: usize, choice: &FigureTokens, selection: Option<Selection>) -> Markup {
    let per_view = exhibit.grid.iter().product();
    let EvalKey { num_storage_tokens: stored, num_render_tokens: rendered, .. } = choice.setting;
    let others: Vec<u32> = choice.stored.iter().copied().filter(|id| !choice.chosen.contains(id)).collect();
    let by = selection.map_or_else(String::new, |selection| format!(" by {selection}"));
    let strip = html! {
        @for (view, index) in exhibit.context_frames.iter().enumerate() {
            @let content = html! {
                use.dim href={ "#s" (number) "v" (view) } {}
                path.stored d=(rings(&others, view, exhibit.grid, 0.22)) {}
                path.chosen d=(rings(&choice.chosen, view, exhibit.grid, 0.34)) {}
            };
            @let caption = html! { "frame " (index) br; (num_in_view(&choice.chosen, view, per_view)) " chosen" };
            (map(exhibit, &format!("Chosen tokens over the context view of frame {index}"), content, caption))
        }
    };
    row(&format!("{rendered} of {stored} tokens chosen for the target{by}"), strip)
}

/// A figure in units of patches.
fn map(exhibit: &SceneFigure, label: &str, content: Markup, caption: Markup) -> Markup {
    let [rows, columns] = exhibit.grid;
    html! {
        figure {
            svg viewBox={ "0 0 " (columns) " " (rows) } role="img" aria-label=(label) { (content) }
            figcaption { (caption) }
        }
    }
}

/// Counts the patches of one view.
fn num_in_view(ids: &[u32], view: usize, per_view: usize) -> usize {
    ids.iter().filter(|&&id| id as usize / per_view == view).count()
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
