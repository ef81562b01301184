//! Points at the line of a configuration that is wrong, in the layout of a compiler's message.

use std::ops::Range;
use std::path::Path;

use codespan_reporting::diagnostic::{Diagnostic, Label};
use codespan_reporting::files::SimpleFiles;
use codespan_reporting::term::{self, Chars};

/// The texts a configuration was read from, one after the other, so that one offset names a place in any of them.
pub(crate) struct SourceText<'a> {
    /// The file and the overrides, by position in `texts`.
    files: SimpleFiles<String, &'a str>,
    /// Every text with the offset of its first byte.
    texts: Vec<(usize, &'a str)>,
}

impl<'a> SourceText<'a> {
    pub(crate) fn new(path: &Path, file: &'a str, overrides: &'a [String]) -> Self {
        let (mut files, mut texts, mut start) = (SimpleFiles::new(), Vec::new(), 0);
        let names = std::iter::once(path.display().to_string()).chain(std::iter::repeat("--set".to_owned()));
        for (name, text) in names.zip(std::iter::once(file).chain(overrides.iter().map(String::as_str))) {
            files.add(name, text);
            texts.push((start, text));
            start += text.len() + 1;
        }
        Self { files, texts }
    }

    /// The overrides with blanks in front, which move their spans behind the file's, so that one span names one place.
    pub(crate) fn padded_overrides(&self) -> Vec<String> {
        self.texts[1..].iter().map(|(start, text)| format!("{}{text}", " ".repeat(*start))).collect()
    }

    /// Offset of the first byte of an override.
    pub(crate) fn override_start(&self, index: usize) -> usize {
        self.texts[index + 1].0
    }

    /// Describes a mistake at a span of the texts.
    pub(crate) fn at(&self, span: Range<usize>, title: String, label: String) -> Diagnostic<usize> {
        let (id, range) = self.find(span);
        Diagnostic::error().with_message(title).with_label(Label::primary(id, range).with_message(label))
    }

    /// Marks a further span of the texts.
    pub(crate) fn mark(&self, span: Range<usize>, label: String) -> Label<usize> {
        let (id, range) = self.find(span);
        Label::secondary(id, range).with_message(label)
    }

    /// Describes a mistake of the whole file.
    pub(crate) fn whole(&self, title: String) -> Diagnostic<usize> {
        let file = self.files.get(0).map(|file| format!("in {}", file.name()));
        Diagnostic::error().with_message(title).with_notes(file.into_iter().collect())
    }

    /// The text that a span is in, and the place in that text.
    fn find(&self, span: Range<usize>) -> (usize, Range<usize>) {
        let id = self.texts.partition_point(|(start, _)| *start <= span.start) - 1;
        let (start, text) = self.texts[id];
        let [from, to] = [span.start, span.end].map(|at| text.floor_char_boundary(at.saturating_sub(start)));
        (id, from..to.max(from))
    }

    /// Prints a diagnostic without the word "error" in front.
    pub(crate) fn render(&self, diagnostic: &Diagnostic<usize>) -> String {
        let config = term::Config { chars: Chars::ascii(), ..term::Config::default() };
        let text = term::emit_into_string(&config, &self.files, diagnostic);
        let text = text.unwrap_or_else(|_| diagnostic.message.clone());
        text.strip_prefix("error: ").unwrap_or(&text).trim_end().to_owned()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rendered(file: &str, span: Range<usize>) -> String {
        let sources = SourceText::new(Path::new("run.toml"), file, &[]);
        sources.render(&sources.at(span, "bad name".into(), "too big".into()).with_note("help: shrink it"))
    }

    #[test]
    fn a_caret_is_under_each_character_of_the_place() {
        let file = "a = 1\r\nname = \"Größe\" # x\n";
        let start = file.find("\"Gr").unwrap();
        let expected = "bad name
  --> run.toml:2:8
  |
2 | name = \"Größe\" # x
  |        ^^^^^^^ too big
  |
  = help: shrink it";
        assert_eq!(rendered(file, start..start + 9), expected);
    }

    #[test]
    fn a_span_at_or_beyond_the_end_still_has_a_caret() {
        assert!(rendered("a = ", 4..4).contains("1 | a = \n  |     ^ too big"));
        assert!(rendered("a = ", 90..99).contains("a ="));
        assert!(rendered("", 0..0).contains("bad name"));
    }
}
