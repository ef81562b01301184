//! Tables of aligned columns.

use crate::output::visible::visible_line;

/// Formats a header and rows in columns of equal width, two spaces apart.
pub fn table<const COUNT: usize>(header: [&str; COUNT], rows: impl IntoIterator<Item = [String; COUNT]>) -> String {
    let rows = [header.map(String::from)].into_iter().chain(rows);
    let rows: Vec<_> = rows.map(|row| row.map(|cell| visible_line(&cell).into_owned())).collect();
    let width = |column: usize| rows.iter().map(|row| row[column].chars().count()).max().unwrap_or(0) + 2;
    let widths: [usize; COUNT] = std::array::from_fn(width);
    let line = |row: &[String; COUNT]| {
        let cells = row.iter().zip(widths).map(|(cell, width)| format!("{cell:<width$}"));
        cells.collect::<String>().trim_end().to_owned()
    };
    rows.iter().map(line).collect::<Vec<_>>().join("\n")
}
