//! The contact sheet of a scene: a row per target view, a column per method.

use clift_data::Clip;
use clift_scene::view_image;
use embedded_graphics::mono_font::MonoFont;
use embedded_graphics::mono_font::iso_8859_1::{FONT_7X13 as SMALL, FONT_9X18_BOLD as LARGE};

use crate::config::method::Method;
use crate::error::EvalError;
use crate::figures::canvas::{Canvas, ERROR_FULL_SCALE, error_map};
use crate::statistics::view_metrics::best_method;
use crate::sweep::rendered_views::{SceneResults, ScoredViews};

const BACKGROUND: [u8; 3] = [250, 250, 248];
const INK: [u8; 3] = [28, 28, 30];
const FAINT: [u8; 3] = [120, 120, 124];
const MARGIN_PX: usize = 20;
const GAP_PX: usize = 10;
/// Smallest width of a cell, so that images of 32 pixels are large enough to compare by eye.
const MIN_CELL_PX: usize = 192;

/// Draws the kept target views of a scene. Columns: contexts, target, nearest view, other methods with their most tokens, the
/// main method with its fewest and its most tokens, and the error of the last.
///
/// A cell has the size of a target view, magnified by a whole factor to at least 192 pixels. Text that is wider than its
/// cell ends in `..`.
pub(crate) fn contact_sheet(clip: &Clip, results: &SceneResults) -> Result<Canvas, EvalError> {
    let shown = shown(&results.renderings);
    let name = |rendering: &&ScoredViews| match (rendering.key.method.name(), rendering.key.num_storage_tokens) {
        (name, 0) => name.replace('_', " "),
        (name, count) => format!("{name}, {count} tokens"),
    };
    let titles = ["contexts".into(), "target".into()].into_iter().chain(shown.iter().map(name));
    let titles: Vec<String> = titles.chain(["error".into()]).collect();
    let (height, width) = (clip.target.height, clip.target.width);
    let factor = MIN_CELL_PX.div_ceil(width);
    let (cell_width, cell_height) = (width * factor, height * factor);
    let [small, large] = [SMALL, LARGE].map(|font| font.character_size.height as usize);
    let head = MARGIN_PX + large + GAP_PX + small + GAP_PX;
    let row_height = small + GAP_PX / 2 + cell_height + 4 + small + 2 * GAP_PX;
    let full_width = (cell_width + GAP_PX) * titles.len() - GAP_PX;
    let foot = head + row_height * results.kept_views.len();
    let mut sheet = Canvas::new(2 * MARGIN_PX + full_width, foot + small + MARGIN_PX, BACKGROUND);
    let column_x = |column: usize| MARGIN_PX + (cell_width + GAP_PX) * column;
    sheet.write_text(&cut(&clip.key, full_width, &LARGE), MARGIN_PX, MARGIN_PX, &LARGE, INK);
    for (column, title) in titles.iter().enumerate() {
        sheet.write_text(&cut(title, cell_width, &SMALL), column_x(column), head - small - GAP_PX, &SMALL, INK);
    }
    let contexts = clip.context.images.chunks(clip.context.height * clip.context.width * 3);
    let contexts = contexts.map(|rgb| Canvas::from_rgb8(rgb, clip.context.height, clip.context.width));
    let contexts = tiled(&contexts.collect::<Result<Vec<_>, _>>()?, cell_width, cell_height);
    for (row, &view) in results.kept_views.iter().enumerate() {
        let y = head + row_height * row + small + GAP_PX / 2;
        let frame = format!("frame {}", clip.target.frame_index[view]);
        sheet.write_text(&frame, MARGIN_PX, head + row_height * row, &SMALL, FAINT);
        let target = view_image(&clip.target, view);
        sheet.paste(&contexts, column_x(0), y);
        let fitted = |image: Canvas| image.fitted(cell_width, cell_height);
        sheet.paste(&fitted(Canvas::from_unit(&target, height, width)?), column_x(1), y);
        for (i, rendering) in shown.iter().enumerate() {
            let image = Canvas::from_unit(&rendering.images[&view], height, width)?;
            sheet.paste(&fitted(image), column_x(2 + i), y);
            let psnr = format!("{:.2} dB", rendering.metrics[&view].psnr);
            sheet.write_text(&psnr, column_x(2 + i), y + cell_height + 4, &SMALL, INK);
        }
        if let Some(last) = shown.last() {
            let errors = error_map(&last.images[&view], &target, height, width)?;
            sheet.paste(&fitted(errors), column_x(titles.len() - 1), y);
        }
    }
    let scale = format!("error: mean over red, green and blue, black 0 to white {ERROR_FULL_SCALE}");
    sheet.write_text(&cut(&scale, full_width, &SMALL), MARGIN_PX, foot, &SMALL, FAINT);
    Ok(sheet)
}

/// Returns the renderings of a sheet in the order of its columns. Those from some of the stored tokens are left out.
fn shown(renderings: &[ScoredViews]) -> Vec<&ScoredViews> {
    let best = best_method(renderings.iter().map(|rendering| rendering.key));
    let whole = |method: Method| {
        let of_method = renderings.iter().filter(move |one| one.key.method == method && one.key.is_whole());
        let mut found: Vec<&ScoredViews> = of_method.collect();
        found.sort_by_key(|one| one.key.num_storage_tokens);
        found
    };
    let others = Method::own().filter(|method| *method != Method::MeanImage && Some(*method) != best);
    let others = [Method::NearestView].into_iter().chain(others.filter(|method| *method != Method::NearestView));
    let mut shown: Vec<&ScoredViews> = others.filter_map(|method| whole(method).pop()).collect();
    let mut best = best.map(whole).unwrap_or_default();
    if best.len() > 2 {
        best.drain(1..best.len() - 1);
    }
    shown.extend(best);
    shown
}

/// Tiles images into one area, as many columns as rows or one more.
fn tiled(images: &[Canvas], width: usize, height: usize) -> Canvas {
    let mut area = Canvas::new(width, height, BACKGROUND);
    let columns = (images.len() as f64).sqrt().ceil().max(1.0) as usize;
    let rows = images.len().div_ceil(columns).max(1);
    let gap = if columns == 1 { 0 } else { 2 };
    let [tile_width, tile_height] =
        [(width, columns), (height, rows)].map(|(side, count)| (side.saturating_sub(gap * (count - 1)) / count).max(1));
    for (i, image) in images.iter().enumerate() {
        let (x, y) = ((i % columns) * (tile_width + gap), (i / columns) * (tile_height + gap));
        area.paste(&image.fitted(tile_width, tile_height), x, y);
    }
    area
}

/// Shortens text to `width` pixels and marks the cut with `..`.
fn cut(text: &str, width: usize, font: &MonoFont) -> String {
    let fits = width / font.character_size.width as usize;
    if text.chars().count() <= fits {
        return text.to_owned();
    }
    text.chars().take(fits.saturating_sub(2)).chain("..".chars()).collect()
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use clift_core::Pose;

    use super::*;
    use crate::statistics::view_metrics::{EvalKey, ViewMetrics};
    use crate::testing::{f32_key as key, gray_views};

    fn rendering(key: EvalKey) -> ScoredViews {
        let metrics = BTreeMap::from([(0, ViewMetrics::quality(20.0, None))]);
        ScoredViews { key, metrics, images: BTreeMap::from([(0, vec![0.25; 32 * 32 * 3])]) }
    }

    #[test]
    fn sheets_have_every_method_and_magnify_small_images() {
        let views = |frames: Vec<usize>| gray_views((32, 32), 200, vec![Pose::IDENTITY; frames.len()], frames);
        let clip = Clip {
            key: "a room".repeat(200),
            context: views(vec![0, 4, 8, 12]),
            target: views(vec![3]),
            target_weights: None,
        };
        let baselines = [Method::NearestView, Method::MeanImage].map(EvalKey::baseline);
        let counts =
            [4, 8, 16].into_iter().flat_map(|count| [Method::Random, Method::Clift].map(|m| key(m, count, count)));
        let keys: Vec<EvalKey> = baselines.into_iter().chain(counts).chain([key(Method::Clift, 16, 4)]).collect();
        let renderings: Vec<ScoredViews> = keys.into_iter().map(rendering).collect();
        let columns: Vec<String> = shown(&renderings).iter().map(|one| one.key.to_string()).collect();
        assert_eq!(columns, ["nearest_view", "random 16 f32", "clift 4 f32", "clift 16 f32"]);
        let sheet = contact_sheet(&clip, &SceneResults { renderings, kept_views: vec![0] }).unwrap();
        assert_eq!(sheet.width(), 2 * MARGIN_PX + 7 * 192 + 6 * GAP_PX);
        let middle = sheet.height() / 2;
        let column = |column: usize| sheet.pixel(MARGIN_PX + 96 + (192 + GAP_PX) * column, middle);
        assert_eq!([1, 2, 5].map(column), [[200; 3], [64; 3], [64; 3]]);
        assert_eq!(column(6), [255; 3], "an error beyond the scale");
    }

    #[test]
    fn four_images_are_tiled_two_by_two_and_long_text_is_cut() {
        let views = [[1; 3], [2; 3], [3; 3], [4; 3]].map(|colour| Canvas::new(64, 64, colour));
        let area = tiled(&views, 192, 192);
        let corners = [(10, 10), (150, 10), (10, 150), (150, 150)].map(|(x, y)| area.pixel(x, y)[0]);
        assert_eq!(corners, [1, 2, 3, 4]);
        assert_eq!(["abcdefgh", "abcdefghi"].map(|text| cut(text, 7 * 8, &SMALL)), ["abcdefgh", "abcdef.."]);
    }
}
