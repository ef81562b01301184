//! Error messages that show a line of a configuration with a caret, as compilers do.

use std::ops::Range;
use std::path::Path;

use codespan_reporting::diagnostic::{Diagnostic, Label};
use codespan_reporting::files::SimpleFiles;
use codespan_reporting::term::{self, Chars};

/// The texts of a configuration. Offsets count through all of them, one after the other.
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

    /// Returns the offset and the text of each override. The text is padded with as many spaces, so that its spans follow those
    /// of the file.
    pub(crate) fn padded_overrides(&self) -> Vec<(usize, String)> {
        self.texts[1..].iter().map(|(start, text)| (*start, format!("{}{text}", " ".repeat(*start)))).collect()
    }

    pub(crate) fn at(&self, span: Range<usize>, title: String, label: String) -> Diagnostic<usize> {
        let (id, range) = self.find(span);
        Diagnostic::error().with_message(title).with_label(Label::primary(id, range).with_message(label))
    }

    pub(crate) fn mark(&self, span: Range<usize>, label: String) -> Label<usize> {
        let (id, range) = self.find(span);
        Label::secondary(id, range).with_message(label)
    }

    pub(crate) fn whole(&self, title: String) -> Diagnostic<usize> {
        let file = self.files.get(0).map(|file| format!("in {}", file.name()));
        Diagnostic::error().with_message(title).with_notes(file.into_iter().collect())
    }

    /// Returns the text of a span, and the range in this text.
    fn find(&self, span: Range<usize>) -> (usize, Range<usize>) {
        let id = self.texts.partition_point(|(start, _)| *start <= span.start) - 1;
        let (start, text) = self.texts[id];
        let [from, to] = [span.start, span.end].map(|at| text.floor_char_boundary(at.saturating_sub(start)));
        (id, from..to.max(from))
    }

    /// Formats a diagnostic without the leading word "error".
    pub(crate) fn render(&self, diagnostic: &Diagnostic<usize>) -> String {
        let config = term::Config { chars: Chars::ascii(), ..term::Config::default() };
        let text = term::emit_into_string(&config, &self.files, diagnostic);
        let text = text.unwrap_or_else(|_| diagnostic.message.clone());
        text.strip_prefix("error: ").unwrap_or(&text).trim_end().to_owned()
    }
}
