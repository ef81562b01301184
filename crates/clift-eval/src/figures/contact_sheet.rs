//! The contact sheet of a report: a row per target view, a column per thing to compare.

use crate::figures::canvas::{Canvas, ERROR_FULL_SCALE, TextSize, error_colour};

const BACKGROUND: [u8; 3] = [250, 250, 248];
const INK: [u8; 3] = [28, 28, 30];
const FAINT: [u8; 3] = [120, 120, 124];
const MARGIN_PX: usize = 20;
const GAP_PX: usize = 10;
/// Cells are at least this wide, so that pictures of 32 pixels can be judged by eye.
const MIN_CELL_PX: usize = 192;
const LEGEND_PX: usize = 192;

/// One place of the sheet: a picture, or several small ones tiled into the same area.
#[derive(Clone, Debug)]
pub struct Cell {
    /// What is shown: one picture fills the cell, more are tiled.
    pub pictures: Vec<Canvas>,
    /// A line under the picture, such as `24.31 dB`; may be empty.
    pub caption: String,
}

/// A labelled row of cells, one target view.
#[derive(Clone, Debug)]
pub struct Row {
    /// What the row is, such as `living-room, frame 17`.
    pub label: String,
    /// One cell per column.
    pub cells: Vec<Cell>,
}

/// Lays out a sheet: title, column titles, rows, and the scale of the error maps at the foot.
///
/// Cells take the size of the first picture that stands alone in its cell, magnified by a whole
/// factor to at least 192 pixels. Text that is too wide for its cell ends in `..`.
pub fn contact_sheet(title: &str, columns: &[&str], rows: &[Row]) -> Canvas {
    let cells = || rows.iter().flat_map(|row| &row.cells);
    let model = cells().find(|cell| cell.pictures.len() == 1).and_then(|cell| cell.pictures.first());
    let (width, height) = model.map_or((1, 1), |picture| (picture.width().max(1), picture.height().max(1)));
    let factor = MIN_CELL_PX.div_ceil(width);
    let (cell_width, cell_height) = (width * factor, height * factor);
    let (small, large) = (TextSize::Small.glyph_px().1, TextSize::Large.glyph_px().1);

    let head = MARGIN_PX + large + GAP_PX + small + GAP_PX;
    let row_height = small + GAP_PX / 2 + cell_height + 4 + small + 2 * GAP_PX;
    let foot = small + MARGIN_PX;
    let pitch = cell_width + GAP_PX;
    let mut canvas = Canvas::new(
        2 * MARGIN_PX + (pitch * columns.len()).saturating_sub(GAP_PX).max(LEGEND_PX),
        head + row_height * rows.len() + foot,
        BACKGROUND,
    );

    let full_width = canvas.width() - 2 * MARGIN_PX;
    canvas.write_text(&cut(title, full_width, TextSize::Large), MARGIN_PX, MARGIN_PX, TextSize::Large, INK);
    for (column, title) in columns.iter().enumerate() {
        let x = MARGIN_PX + pitch * column;
        canvas.write_text(&cut(title, cell_width, TextSize::Small), x, head - small - GAP_PX, TextSize::Small, INK);
    }
    for (i, row) in rows.iter().enumerate() {
        let top = head + row_height * i;
        canvas.write_text(&cut(&row.label, full_width, TextSize::Small), MARGIN_PX, top, TextSize::Small, FAINT);
        for (column, cell) in row.cells.iter().enumerate() {
            let (x, y) = (MARGIN_PX + pitch * column, top + small + GAP_PX / 2);
            canvas.paste(&tiled(&cell.pictures, cell_width, cell_height), x, y);
            let caption = cut(&cell.caption, cell_width, TextSize::Small);
            canvas.write_text(&caption, x, y + cell_height + 4, TextSize::Small, INK);
        }
    }
    paint_legend(&mut canvas, head + row_height * rows.len());
    canvas
}

/// Tiles pictures into one area, in the fewest columns that make the tiles largest.
fn tiled(pictures: &[Canvas], width: usize, height: usize) -> Canvas {
    let mut area = Canvas::new(width, height, BACKGROUND);
    let Some(first) = pictures.first() else { return area };
    let gap = if pictures.len() == 1 { 0 } else { 2 };
    let tile = |columns: usize| {
        let rows = pictures.len().div_ceil(columns);
        let fit = |space: usize, count: usize| (space.saturating_sub(gap * (count - 1)) / count).max(1);
        (fit(width, columns), fit(height, rows))
    };
    let shown = |(w, h): (usize, usize)| (w * first.height()).min(h * first.width());
    let columns = (1..=pictures.len()).rev().max_by_key(|&columns| shown(tile(columns))).unwrap_or(1);
    let (tile_width, tile_height) = tile(columns);
    for (i, picture) in pictures.iter().enumerate() {
        let picture = picture.fitted(tile_width, tile_height);
        area.paste(&picture, (i % columns) * (tile_width + gap), (i / columns) * (tile_height + gap));
    }
    area
}

fn paint_legend(canvas: &mut Canvas, y: usize) {
    let (glyph, height) = TextSize::Small.glyph_px();
    let before = "error 0";
    canvas.write_text(before, MARGIN_PX, y, TextSize::Small, FAINT);
    let bar = LEGEND_PX.saturating_sub(glyph * 18).max(48);
    let x = MARGIN_PX + glyph * (before.len() + 1);
    for i in 0..bar {
        let colour = error_colour(i as f32 / (bar - 1) as f32);
        canvas.paste(&Canvas::new(1, height, colour), x + i, y);
    }
    canvas.write_text(&format!("{ERROR_FULL_SCALE}"), x + bar + glyph, y, TextSize::Small, FAINT);
}

/// Shortens text to what fits `width` pixels, marked with `..`.
fn cut(text: &str, width: usize, size: TextSize) -> String {
    let fits = width / size.glyph_px().0;
    if text.chars().count() <= fits {
        return text.to_owned();
    }
    text.chars().take(fits.saturating_sub(2)).chain("..".chars()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn one(picture: Canvas, caption: &str) -> Cell {
        Cell { pictures: vec![picture], caption: caption.to_owned() }
    }

    #[test]
    fn cells_are_at_least_192_pixels_wide_and_never_blurred() {
        let mut picture = Canvas::new(32, 32, [0, 0, 255]);
        picture.paste(&Canvas::new(16, 32, [255, 0, 0]), 0, 0);
        let row = Row { label: String::new(), cells: vec![one(picture, ""), one(Canvas::new(32, 32, [0; 3]), "")] };
        let sheet = contact_sheet("t", &["a", "b"], &[row]);
        assert_eq!(sheet.width(), 2 * MARGIN_PX + 2 * 192 + GAP_PX);
        let middle = sheet.height() / 2;
        let colours: Vec<_> = (0..192).map(|x| sheet.pixel(MARGIN_PX + x, middle)).collect();
        assert_eq!(colours, [[[255, 0, 0]; 96], [[0, 0, 255]; 96]].concat());
    }

    #[test]
    fn four_context_views_are_tiled_two_by_two() {
        let views = [[1; 3], [2; 3], [3; 3], [4; 3]].map(|colour| Canvas::new(64, 64, colour));
        let area = tiled(&views, 192, 192);
        let corners = [(10, 10), (150, 10), (10, 150), (150, 150)].map(|(x, y)| area.pixel(x, y)[0]);
        assert_eq!(corners, [1, 2, 3, 4]);
    }

    #[test]
    fn text_that_is_too_wide_is_cut_with_dots() {
        assert_eq!(cut("abcdefgh", 7 * 8, TextSize::Small), "abcdefgh");
        assert_eq!(cut("abcdefghi", 7 * 8, TextSize::Small), "abcdef..");
    }

    #[test]
    fn a_sheet_without_rows_is_still_a_picture() {
        assert!(contact_sheet("nothing was rendered", &[], &[]).height() > 0);
    }
}
