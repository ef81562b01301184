//! The contact sheet of a scene: a row per target view, a column per method.

use embedded_graphics::mono_font::MonoFont;
use embedded_graphics::mono_font::iso_8859_1::{FONT_7X13 as SMALL, FONT_9X18_BOLD as LARGE};

use crate::figures::canvas::{Canvas, ERROR_FULL_SCALE, error_colour};

const BACKGROUND: [u8; 3] = [250, 250, 248];
const INK: [u8; 3] = [28, 28, 30];
const FAINT: [u8; 3] = [120, 120, 124];
const MARGIN_PX: usize = 20;
const GAP_PX: usize = 10;
/// Smallest width of a cell, so that images of 32 pixels are large enough to compare by eye.
const MIN_CELL_PX: usize = 192;
const LEGEND_PX: usize = 192;

#[derive(Clone, Debug)]
pub struct Cell {
    /// One image fills the cell; several images are tiled.
    pub images: Vec<Canvas>,
    /// Line below the image, such as `24.31 dB`; may be empty.
    pub caption: String,
}

/// A labelled row of cells, one target view.
#[derive(Clone, Debug)]
pub struct Row {
    /// Label above the row, such as `frame 17`.
    pub label: String,
    pub cells: Vec<Cell>,
}

/// Makes a sheet of title, column titles, rows, and the colour scale of the error maps.
///
/// A cell has the size of the first image that is alone in its cell, magnified by a whole factor to at least 192 pixels.
/// Text that is wider than its cell ends in `..`.
pub fn contact_sheet(title: &str, columns: &[&str], rows: &[Row]) -> Canvas {
    let cells = || rows.iter().flat_map(|row| &row.cells);
    let first = cells().find(|cell| cell.images.len() == 1).and_then(|cell| cell.images.first());
    let (width, height) = first.map_or((1, 1), |image| (image.width().max(1), image.height().max(1)));
    let factor = MIN_CELL_PX.div_ceil(width);
    let (cell_width, cell_height) = (width * factor, height * factor);
    let [small, large] = [SMALL, LARGE].map(|font| font.character_size.height as usize);
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
    canvas.write_text(&cut(title, full_width, &LARGE), MARGIN_PX, MARGIN_PX, &LARGE, INK);
    for (column, title) in columns.iter().enumerate() {
        let x = MARGIN_PX + pitch * column;
        canvas.write_text(&cut(title, cell_width, &SMALL), x, head - small - GAP_PX, &SMALL, INK);
    }
    for (i, row) in rows.iter().enumerate() {
        let top = head + row_height * i;
        canvas.write_text(&cut(&row.label, full_width, &SMALL), MARGIN_PX, top, &SMALL, FAINT);
        for (column, cell) in row.cells.iter().enumerate() {
            let (x, y) = (MARGIN_PX + pitch * column, top + small + GAP_PX / 2);
            canvas.paste(&tiled(&cell.images, cell_width, cell_height), x, y);
            let caption = cut(&cell.caption, cell_width, &SMALL);
            canvas.write_text(&caption, x, y + cell_height + 4, &SMALL, INK);
        }
    }
    paint_legend(&mut canvas, head + row_height * rows.len());
    canvas
}

/// Tiles images into one area, in the fewest columns with the largest tiles.
fn tiled(images: &[Canvas], width: usize, height: usize) -> Canvas {
    let mut area = Canvas::new(width, height, BACKGROUND);
    let Some(first) = images.first() else { return area };
    let gap = if images.len() == 1 { 0 } else { 2 };
    let tile = |columns: usize| {
        let rows = images.len().div_ceil(columns);
        let fit = |space: usize, count: usize| (space.saturating_sub(gap * (count - 1)) / count).max(1);
        (fit(width, columns), fit(height, rows))
    };
    let scale = |(w, h): (usize, usize)| (w * first.height()).min(h * first.width());
    let columns = (1..=images.len()).rev().max_by_key(|&columns| scale(tile(columns))).unwrap_or(1);
    let (tile_width, tile_height) = tile(columns);
    for (i, image) in images.iter().enumerate() {
        let image = image.fitted(tile_width, tile_height);
        area.paste(&image, (i % columns) * (tile_width + gap), (i / columns) * (tile_height + gap));
    }
    area
}

fn paint_legend(canvas: &mut Canvas, y: usize) {
    let [glyph, height] = [SMALL.character_size.width, SMALL.character_size.height].map(|side| side as usize);
    let before = "error 0";
    canvas.write_text(before, MARGIN_PX, y, &SMALL, FAINT);
    let bar = LEGEND_PX.saturating_sub(glyph * 18).max(48);
    let x = MARGIN_PX + glyph * (before.len() + 1);
    for i in 0..bar {
        let colour = error_colour(i as f32 / (bar - 1) as f32);
        canvas.paste(&Canvas::new(1, height, colour), x + i, y);
    }
    canvas.write_text(&format!("{ERROR_FULL_SCALE}"), x + bar + glyph, y, &SMALL, FAINT);
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
    use super::*;

    fn one(image: Canvas, caption: &str) -> Cell {
        Cell { images: vec![image], caption: caption.to_owned() }
    }

    #[test]
    fn small_images_are_magnified_to_192_pixels_unblurred() {
        let mut image = Canvas::new(32, 32, [0, 0, 255]);
        image.paste(&Canvas::new(16, 32, [255, 0, 0]), 0, 0);
        let row = Row { label: String::new(), cells: vec![one(image, ""), one(Canvas::new(32, 32, [0; 3]), "")] };
        let sheet = contact_sheet("t", &["a", "b"], &[row]);
        assert_eq!(sheet.width(), 2 * MARGIN_PX + 2 * 192 + GAP_PX);
        let middle = sheet.height() / 2;
        let colours: Vec<_> = (0..192).map(|x| sheet.pixel(MARGIN_PX + x, middle)).collect();
        assert_eq!(colours, [[[255, 0, 0]; 96], [[0, 0, 255]; 96]].concat());
    }

    #[test]
    fn four_images_are_tiled_two_by_two() {
        let views = [[1; 3], [2; 3], [3; 3], [4; 3]].map(|colour| Canvas::new(64, 64, colour));
        let area = tiled(&views, 192, 192);
        let corners = [(10, 10), (150, 10), (10, 150), (150, 150)].map(|(x, y)| area.pixel(x, y)[0]);
        assert_eq!(corners, [1, 2, 3, 4]);
    }

    #[test]
    fn long_text_is_cut_and_sheets_may_be_empty() {
        assert_eq!(cut("abcdefgh", 7 * 8, &SMALL), "abcdefgh");
        assert_eq!(cut("abcdefghi", 7 * 8, &SMALL), "abcdef..");
        assert!(contact_sheet("no rows", &[], &[]).height() > 0);
    }
}
