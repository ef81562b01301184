//! Control characters of data, such as scene keys, made visible: a terminal would execute them.

use std::borrow::Cow;

/// Escapes control characters except line ends: `\u{1b}`.
pub(crate) fn visible(text: &str) -> Cow<'_, str> {
    escaped(text, |c| c.is_control() && c != '\n')
}

/// Escapes all control characters, for text within a line.
pub(crate) fn visible_line(text: &str) -> Cow<'_, str> {
    escaped(text, char::is_control)
}

fn escaped(text: &str, is_escaped: impl Fn(char) -> bool) -> Cow<'_, str> {
    if !text.contains(&is_escaped) {
        return Cow::Borrowed(text);
    }
    let escape = |c: char| if is_escaped(c) { c.escape_default().to_string() } else { c.to_string() };
    Cow::Owned(text.chars().map(escape).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn control_characters_are_escaped_and_other_text_is_kept() {
        assert_eq!(visible("a\u{1b}[2Jb\u{9b}\r\nc\u{7}"), "a\\u{1b}[2Jb\\u{9b}\\r\nc\\u{7}");
        assert_eq!(visible_line("a\nb\t"), "a\\nb\\t");
        assert!(matches!(visible("Zürich \\ 100 %\n"), Cow::Borrowed(_)));
    }
}
