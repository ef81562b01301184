//! Parts of every section: numbers as text, table heads, images as data URIs. maud escapes all text.

use std::io;

use base64::prelude::{BASE64_STANDARD, Engine};
use maud::{Markup, html};

use crate::figures::canvas::Canvas;
use crate::report::axis::grouped;

pub const DASH: &str = "\u{2013}";

/// Returns a value as text; a dash without a finite value.
pub fn number(value: Option<f64>, decimals: usize) -> String {
    value.filter(|value| value.is_finite()).map_or_else(|| DASH.into(), |value| grouped(value, decimals))
}

pub fn count(count: usize) -> String {
    grouped(count as f64, 0)
}

/// Returns a message, its parts in backquotes as code.
pub fn text(message: &str) -> Markup {
    html! {
        @for (i, part) in message.split('`').enumerate() {
            @if i % 2 == 1 { code { (part) } } @else { (part) }
        }
    }
}

/// Returns a table that scrolls within the page. A line break in a name of the head starts a second line.
pub fn table(class: Option<&str>, head: &[&str], rows: &Markup) -> Markup {
    html! {
        div.scroll {
            table class=[class] {
                @if !head.is_empty() {
                    thead {
                        tr {
                            @for name in head {
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
                tbody { (rows) }
            }
        }
    }
}

pub fn data_uri(image: &Canvas) -> io::Result<String> {
    Ok(format!("data:image/png;base64,{}", BASE64_STANDARD.encode(image.png()?)))
}
