//! What every section of the page needs: numbers as text, table heads, images as addresses. maud escapes all text.

use std::io;

use base64::prelude::{BASE64_STANDARD, Engine};
use maud::{Markup, html};

use crate::figures::canvas::Canvas;
use crate::report::axis::grouped;

/// Shown where a value was not measured.
pub const DASH: &str = "\u{2013}";

/// Returns a value as text, a dash where it was not measured.
pub fn number(value: Option<f64>, decimals: usize) -> String {
    value.filter(|value| value.is_finite()).map_or_else(|| DASH.into(), |value| grouped(value, decimals))
}

/// Returns a count with a comma between thousands.
pub fn count(count: usize) -> String {
    grouped(count as f64, 0)
}

/// Returns the head of a table; a line break in a name starts its second line.
pub fn head(names: &[&str]) -> Markup {
    html! {
        thead {
            tr {
                @for name in names {
                    th scope="col" {
                        @for (i, line) in name.lines().enumerate() {
                            @if i > 0 { br; }
                            (line)
                        }
                    }
                }
            }
        }
    }
}

/// Returns an image as an address that holds its bytes, for `src` and `href`.
///
/// # Errors
/// As [`Canvas::png`].
pub fn data_uri(picture: &Canvas) -> io::Result<String> {
    Ok(format!("data:image/png;base64,{}", BASE64_STANDARD.encode(picture.png()?)))
}
