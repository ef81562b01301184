//! Points at the place in a configuration that is wrong, in the layout of a compiler's message.

use std::fmt;
use std::ops::Range;
use std::path::Path;

/// One mistake in a configuration: what, where, the line with a caret under the place, and the fix.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Diagnostic {
    title: String,
    place: String,
    line_number: Option<usize>,
    /// The line's text, the column and the width of the caret in characters, and what stands beside it.
    snippet: Option<(String, usize, usize, String)>,
    help: Vec<String>,
}

impl Diagnostic {
    /// Adds a line of help at the end.
    #[must_use]
    pub(crate) fn with_help(mut self, help: String) -> Self {
        self.help.push(help);
        self
    }
}

impl fmt::Display for Diagnostic {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let number = self.line_number.map(|number| number.to_string()).unwrap_or_default();
        let gutter = " ".repeat(number.len());
        write!(f, "{}\n{gutter}--> {}", self.title, self.place)?;
        if let Some((line, column, width, label)) = &self.snippet {
            let (indent, carets) = (" ".repeat(*column), "^".repeat((*width).max(1)));
            write!(f, "\n{gutter} |\n{number} | {line}\n{gutter} | {indent}{carets}")?;
            if !label.is_empty() {
                write!(f, " {label}")?;
            }
        }
        for help in &self.help {
            write!(f, "\n{gutter} = help: {help}")?;
        }
        Ok(())
    }
}

/// The texts a configuration was read from, one after the other, so that one offset names a place in any of them.
pub(crate) struct Sources<'a> {
    path: &'a Path,
    file: &'a str,
    overrides: &'a [String],
}

impl<'a> Sources<'a> {
    pub(crate) fn new(path: &'a Path, file: &'a str, overrides: &'a [String]) -> Self {
        Self { path, file, overrides }
    }

    /// Offset of the first byte of an override.
    pub(crate) fn override_start(&self, index: usize) -> usize {
        let before: usize = self.overrides[..index].iter().map(|text| text.len() + 1).sum();
        self.file.len() + 1 + before
    }

    /// The overrides with blanks in front, which move their spans behind the file's, so that one span names one place.
    pub(crate) fn padded_overrides(&self) -> Vec<String> {
        let padded = |index| format!("{}{}", " ".repeat(self.override_start(index)), self.overrides[index]);
        (0..self.overrides.len()).map(padded).collect()
    }

    /// Where a span of the texts is, in words.
    pub(crate) fn place(&self, span: &Range<usize>) -> String {
        if span.start > self.file.len() {
            return "by --set".to_owned();
        }
        let start = floor_char_boundary(self.file, span.start);
        format!("in line {}", self.file[..start].matches('\n').count() + 1)
    }

    /// Describes a mistake at a span of the texts; a span beyond one line is marked on its first line.
    pub(crate) fn at(&self, span: Range<usize>, title: String, label: String) -> Diagnostic {
        let index = (0..self.overrides.len()).rev().find(|&index| span.start >= self.override_start(index));
        let (text, start) = match index {
            Some(index) => (self.overrides[index].as_str(), span.start - self.override_start(index)),
            None => (self.file, span.start),
        };
        let start = floor_char_boundary(text, start);
        let end = floor_char_boundary(text, start + span.len()).max(start);
        let line_start = text[..start].rfind('\n').map_or(0, |newline| newline + 1);
        let line_end = text[start..].find('\n').map_or(text.len(), |newline| start + newline);
        let line = text[line_start..line_end].trim_end_matches('\r').replace('\t', " ");
        let column = text[line_start..start].chars().count();
        let width = text[start..end.min(line_end)].trim_end().chars().count();
        let line_number = index.is_none().then(|| text[..start].matches('\n').count() + 1);
        let place = match line_number {
            Some(number) => format!("{}:{number}:{}", self.path.display(), column + 1),
            None => "--set".to_owned(),
        };
        Diagnostic { title, place, line_number, snippet: Some((line, column, width, label)), help: Vec::new() }
    }

    /// Describes a mistake of the whole file.
    pub(crate) fn whole(&self, title: String) -> Diagnostic {
        let place = self.path.display().to_string();
        Diagnostic { title, place, line_number: None, snippet: None, help: Vec::new() }
    }
}

fn floor_char_boundary(text: &str, index: usize) -> usize {
    (0..=index.min(text.len())).rev().find(|&index| text.is_char_boundary(index)).unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_place_is_shown_with_its_line_and_a_caret_under_each_character() {
        let file = "a = 1\r\nname = \"Größe\" # x\n";
        let start = file.find("\"Gr").unwrap();
        let sources = Sources::new(Path::new("run.toml"), file, &[]);
        let diagnostic =
            sources.at(start..start + 9, "bad name".into(), "too big".into()).with_help("shrink it".into());
        let expected = "bad name
 --> run.toml:2:8
  |
2 | name = \"Größe\" # x
  |        ^^^^^^^ too big
  = help: shrink it";
        assert_eq!(diagnostic.to_string(), expected);
    }

    #[test]
    fn a_place_in_an_override_shows_the_override() {
        let overrides = ["a=1".to_owned(), "bb=2".to_owned()];
        let sources = Sources::new(Path::new("run.toml"), "a = 0\n", &overrides);
        let start = sources.override_start(1);
        let expected = "unknown key\n--> --set\n |\n | bb=2\n | ^^";
        assert_eq!(sources.at(start..start + 2, "unknown key".into(), String::new()).to_string(), expected);
    }

    #[test]
    fn a_span_at_the_end_of_the_file_still_has_a_caret() {
        let sources = Sources::new(Path::new("run.toml"), "a = ", &[]);
        let shown = sources.at(4..4, "no value".into(), String::new()).to_string();
        assert!(shown.ends_with("1 | a = \n  |     ^"), "{shown}");
        assert!(sources.at(90..99, String::new(), String::new()).to_string().contains("a ="));
    }
}
