//! One scene of a report: images, clusters, and the tokens selected for a view.

use std::io;

use clift_model::SceneClusters;
use maud::{Markup, html};

use crate::config::method::Method;
use crate::config::token_selection::Selection;
use crate::figures::canvas::Canvas;
use crate::figures::scene_figure::{FigureImage, FigureTokens, SceneFigure};
use crate::report::axis::grouped;
use crate::report::html::data_uri;
use crate::statistics::view_metrics::{EvalKey, best_method};
use crate::sweep::rendered_views::spread;

/// Largest number of token counts per method on the page.
const MAX_COUNTS: usize = 4;

/// Largest number of cluster maps per scene, and of selections.
const MAX_MAPS: usize = 2;

/// Width below which the browser magnifies an image without smoothing.
const SHARP_BELOW_PX: usize = 100;

/// Returns the section of a scene. `number` makes the section's ids unique on the page; `selection` names the rules that
/// selected tokens.
pub fn section(figure: &SceneFigure, number: usize, selection: Option<Selection>) -> io::Result<Markup> {
    let is_map = |clusters: &&SceneClusters| clusters.centroid_index().len() < clusters.assignment().len();
    let maps: Vec<&SceneClusters> = figure.clusters.iter().filter(is_map).collect();
    let best = best_method(figure.selections.iter().map(|tokens| tokens.key));
    let selections = figure.selections.iter().filter(|tokens| Some(tokens.key.method) == best);
    let most = selections.clone().map(|tokens| tokens.key.num_storage_tokens).max();
    let selections: Vec<&FigureTokens> =
        selections.filter(|tokens| Some(tokens.key.num_storage_tokens) == most).collect();
    Ok(html! {
        article.scene {
            h3 { (figure.scene) }
            div.halves {
                div { (image_rows(figure)?) }
                div {
                    (contexts(figure, number)?)
                    @for map in spread(maps.len(), MAX_MAPS) { (clusters(figure, number, maps[map])?) }
                    @for i in spread(selections.len(), MAX_MAPS) {
                        (selected(figure, number, selections[i], selection))
                    }
                }
            }
        }
    })
}

fn row(heading: &str, strip: Markup) -> Markup {
    html! { div.row { h4 { (heading) } div.strip { (strip) } } }
}

fn image_rows(figure: &SceneFigure) -> io::Result<Markup> {
    let target_frame = figure.target_frame;
    let of = |method: Method| figure.images.iter().filter(move |image| image.key.method == method);
    let best = best_method(figure.images.iter().map(|image| image.key));
    let some = figure.images.iter().filter(|d| Some(d.key.method) == best && !d.key.is_whole());
    let most = some.clone().map(|image| image.key.num_storage_tokens).max();
    let some = some.filter(|image| Some(image.key.num_storage_tokens) == most);
    let target = html! {
        (image_html(&figure.target, &format!("Target view, frame {target_frame}"), frame(target_frame))?)
        @for nearest in of(Method::NearestView) { (rendering(nearest, "nearest view")?) }
    };
    let clustered = [Method::Clift, Method::Kmeans, Method::TileClift, Method::Tile, Method::Random];
    Ok(html! {
        (row("target", target))
        @for method in clustered.into_iter().chain(Method::whole()) {
            (strip(method.name(), &of(method).filter(|image| image.key.is_whole()).collect::<Vec<_>>())?)
            @if Some(method) == best { (errors(&figure.images)?) }
        }
        @for other in &figure.images {
            @if let Method::External(name) = other.key.method {
                (row(name.as_str(), rendering(other, "its image")?))
            }
        }
        (strip(&format!("{}, some tokens", best.as_ref().map_or("", Method::name)), &some.collect::<Vec<_>>())?)
    })
}

/// Returns a row of at most `MAX_COUNTS` images, by ascending token counts; nothing for no image.
fn strip(heading: &str, images: &[&FigureImage]) -> io::Result<Markup> {
    let tokens = |EvalKey { num_storage_tokens: stored, num_render_tokens: rendered, .. }| {
        if stored == rendered { format!("{stored} tokens") } else { format!("{rendered} of {stored}") }
    };
    let content = html! {
        @for i in spread(images.len(), MAX_COUNTS) { (rendering(images[i], &tokens(images[i].key))?) }
    };
    Ok(if images.is_empty() { Markup::default() } else { row(heading, content) })
}

/// Returns the error maps of the nearest view and of the main method with its fewest and its most tokens.
fn errors(images: &[FigureImage]) -> io::Result<Markup> {
    let (nearest, rendered): (Vec<_>, Vec<_>) = images
        .iter()
        .filter(|image| image.key.is_whole())
        .filter_map(|image| Some((image, image.error.as_ref()?)))
        .partition(|(image, _)| image.key.method == Method::NearestView);
    let ends = spread(rendered.len(), 2).into_iter().map(|i| rendered[i]);
    let content = html! {
        @for (image, error) in nearest.into_iter().chain(ends) {
            @let of = match image.key.num_storage_tokens {
                0 => "nearest view".to_owned(),
                count => format!("{count} tokens"),
            };
            (image_html(error, &format!("Error map of {of}"), html! { "error, " (of) })?)
        }
    };
    Ok(row("error maps", content))
}

fn rendering(image: &FigureImage, what: &str) -> io::Result<Markup> {
    let psnr = if image.psnr.is_finite() { grouped(image.psnr, 2) } else { "\u{221e}".into() };
    let alt = format!("The target rendered by {}, {what}, {psnr} dB", image.key.method.name().replace('_', " "));
    image_html(&image.image, &alt, html! { (what) br; (psnr) " dB" })
}

fn image_html(image: &Canvas, alt: &str, caption: Markup) -> io::Result<Markup> {
    let (width, height) = (image.width(), image.height());
    Ok(html! {
        figure {
            img class=(sharpness(image)) width=(width) height=(height) alt=(alt) src=(data_uri(image)?);
            figcaption { (caption) }
        }
    })
}

fn sharpness(image: &Canvas) -> &'static str {
    if image.width() < SHARP_BELOW_PX { "sharp" } else { "smooth" }
}

fn frame(frame: usize) -> Markup {
    html! { "frame " (frame) }
}

/// Returns the context images. The maps refer to the images by id.
fn contexts(figure: &SceneFigure, number: usize) -> io::Result<Markup> {
    let [rows, columns] = figure.grid;
    let strip = html! {
        @for (view, (image, &index)) in figure.context.iter().zip(&figure.context_frames).enumerate() {
            @let content = html! {
                image id={ "s" (number) "v" (view) } class=(sharpness(image)) href=(data_uri(image)?)
                    width=(columns) height=(rows) preserveAspectRatio="none" {}
            };
            (map(figure, &format!("Context view, frame {index}"), content, frame(index)))
        }
    };
    Ok(row("context views", strip))
}

/// Returns a map of the context patches in the colours of their clusters, with rings around the centroids.
fn clusters(figure: &SceneFigure, number: usize, clusters: &SceneClusters) -> io::Result<Markup> {
    let [rows, columns] = figure.grid;
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
            clusters.assignment().chunks(per_view).zip(&figure.context_frames).enumerate()
        {
            @let content = html! {
                use.grey href={ "#s" (number) "v" (view) } {}
                image.tint href=(tint(assignment)?) width=(columns) height=(rows) preserveAspectRatio="none" {}
                path.ring d=(rings(centroids, view, figure.grid, 0.3)) {}
            };
            @let caption = html! { "frame " (index) br; (num_in_view(centroids, view, per_view)) " centroids" };
            (map(figure, &format!("Clusters over the context view of frame {index}"), content, caption))
        }
    };
    Ok(row(&format!("{} clusters", centroids.len()), strip))
}

/// Returns a map of the stored tokens: dots for the tokens selected for the target, rings for the others.
fn selected(figure: &SceneFigure, number: usize, tokens: &FigureTokens, selection: Option<Selection>) -> Markup {
    let per_view = figure.grid.iter().product();
    let EvalKey { num_storage_tokens: stored, num_render_tokens: rendered, .. } = tokens.key;
    let others: Vec<u32> = tokens.stored.iter().copied().filter(|id| !tokens.selected.contains(id)).collect();
    let by = selection.map_or_else(String::new, |selection| format!(" by {selection}"));
    let strip = html! {
        @for (view, index) in figure.context_frames.iter().enumerate() {
            @let content = html! {
                use.dim href={ "#s" (number) "v" (view) } {}
                path.stored d=(rings(&others, view, figure.grid, 0.22)) {}
                path.selected d=(rings(&tokens.selected, view, figure.grid, 0.34)) {}
            };
            @let caption = html! { "frame " (index) br; (num_in_view(&tokens.selected, view, per_view)) " selected" };
            (map(figure, &format!("Selected tokens over the context view of frame {index}"), content, caption))
        }
    };
    row(&format!("{rendered} of {stored} tokens selected for the target{by}"), strip)
}

/// Returns a figure in units of patches.
fn map(figure: &SceneFigure, label: &str, content: Markup, caption: Markup) -> Markup {
    let [rows, columns] = figure.grid;
    html! {
        figure {
            svg viewBox={ "0 0 " (columns) " " (rows) } role="img" aria-label=(label) { (content) }
            figcaption { (caption) }
        }
    }
}

fn num_in_view(ids: &[u32], view: usize, per_view: usize) -> usize {
    ids.iter().filter(|&&id| id as usize / per_view == view).count()
}

/// Returns a path of circles around the centres of the patches of one view.
fn rings(ids: &[u32], view: usize, [rows, columns]: [usize; 2], radius: f64) -> String {
    let across = 2.0 * radius;
    let ring = |id: usize| {
        let (x, y) = ((id % columns) as f64 + 0.5 - radius, (id / columns % rows) as f64 + 0.5);
        format!("M{x:.2} {y}a{radius} {radius} 0 1 0 {across} 0a{radius} {radius} 0 1 0 -{across} 0z")
    };
    let ids = ids.iter().map(|&id| id as usize).filter(|id| id / (rows * columns) == view);
    ids.map(ring).collect::<Vec<_>>().concat()
}

/// Returns the colour of a cluster. Hues are a golden section apart, so neighbouring numbers differ clearly.
fn cluster_colour(cluster: u32) -> [u8; 3] {
    const GOLDEN: f64 = 0.618_033_988_75;
    let hue = (f64::from(cluster) * GOLDEN).fract() * 6.0;
    // Three levels of lightness separate hues that come close again.
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
    fn rings_surround_the_patches_of_one_view() {
        // Views of 2 x 3 patches: id 6 is the first patch of the second view, 11 its last.
        let path = rings(&[1, 6, 11], 1, [2, 3], 0.25);
        let starts: Vec<&str> = path.split('M').skip(1).map(|ring| ring.split('a').next().unwrap()).collect();
        assert_eq!(starts, ["0.25 0.5", "2.25 1.5"]);
        assert_eq!(rings(&[1], 1, [2, 3], 0.25), "");
    }

    #[test]
    fn neighbouring_clusters_have_distinct_colours() {
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
