//! Results to stdout, notes to stderr.

use std::io::{ErrorKind, Write};
use std::path::Path;

use anyhow::Context;
use clift_eval::Summary;

/// Writes a line or more to the standard output, at once.
///
/// # Errors
/// The operating system's, except that a reader who has left, as `head` does, is none: the rest is not wanted.
pub fn print_result(text: &str) -> anyhow::Result<()> {
    write_result(std::io::stdout().lock(), text)
}

/// Writes what an evaluation found and where it lies.
///
/// # Errors
/// As [`print_result`].
pub fn print_evaluation(summary: &Summary, folder: &Path) -> anyhow::Result<()> {
    let report = folder.join("report.html");
    print_result(&format!("{summary}\nreport: {}\nresults: {}", report.display(), folder.display()))
}

pub(crate) fn write_result(mut out: impl Write, text: &str) -> anyhow::Result<()> {
    match writeln!(out, "{text}").and_then(|()| out.flush()) {
        Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(()),
        written => written.context("writing to the standard output"),
    }
}

/// Writes a line to the standard error stream, if that can be: there is nowhere to show a failure to show something.
pub fn print_note(text: &str) {
    drop(writeln!(std::io::stderr(), "{text}"));
}
