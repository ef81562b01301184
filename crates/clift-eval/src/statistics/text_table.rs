//! Tables of aligned columns for terminals.

/// Formats a header and rows in columns of equal width, two spaces apart. Escapes control characters, such as those of scene
/// keys, which a terminal would execute.
pub fn table<const COUNT: usize>(header: [&str; COUNT], rows: impl IntoIterator<Item = [String; COUNT]>) -> String {
    let visible = |cell: String| {
        if cell.contains(char::is_control) { cell.escape_debug().to_string() } else { cell }
    };
    let rows = [header.map(String::from)].into_iter().chain(rows);
    let rows: Vec<[String; COUNT]> = rows.map(|row| row.map(visible)).collect();
    let width = |column: usize| rows.iter().map(|row| row[column].chars().count()).max().unwrap_or(0) + 2;
    let widths: [usize; COUNT] = std::array::from_fn(width);
    let line = |row: &[String; COUNT]| {
        let cells = row.iter().zip(widths).map(|(cell, width)| format!("{cell:<width$}"));
        cells.collect::<String>().trim_end().to_owned()
    };
    rows.iter().map(line).collect::<Vec<_>>().join("\n")
}
