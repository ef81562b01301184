//! Results to stdout, notes to stderr.

use std::fmt::Display;
use std::io::{ErrorKind, Write};
use std::path::Path;

use anyhow::Context;
use clift_eval::Summary;
use clift_model::{DeviceName, used_adapter};

use crate::output::visible::visible;
use crate::verbosity::Verbosity;

/// Writes lines to the standard output and flushes them. A closed pipe, as `head` leaves behind, is not an error.
pub fn print_result(text: &str) -> anyhow::Result<()> {
    write_result(std::io::stdout().lock(), text)
}

/// Writes the table of an evaluation and the paths of its report and files.
pub fn print_evaluation(summary: &Summary, folder: &Path) -> anyhow::Result<()> {
    let report = folder.join("report.html");
    print_result(&format!("{summary}\nreport: {}\nresults: {}", report.display(), folder.display()))
}

fn write_result(mut out: impl Write, text: &str) -> anyhow::Result<()> {
    match writeln!(out, "{}", visible(text)).and_then(|()| out.flush()) {
        Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(()),
        written => written.context("writing to the standard output"),
    }
}

/// Writes a line to the standard error, unless the command is quiet.
pub fn print_note(text: &str) {
    if Verbosity::chosen() != Verbosity::Quiet {
        print_problem(text);
    }
}

/// Writes a warning to the standard error.
pub fn print_warning(text: impl Display) {
    print_problem(&format!("warning: {text}"));
}

/// Writes a line to the standard error. A failure is ignored: no other stream could report it.
pub fn print_problem(text: &str) {
    if Verbosity::chosen() == Verbosity::Silent {
        return;
    }
    drop(writeln!(std::io::stderr(), "{}", visible(text)));
}

/// Prints the adapter of `wgpu`; nothing for other devices. `compiles` says that the silence of the first step follows.
pub fn name_adapter(device: DeviceName, compiles: bool) {
    if device != DeviceName::Wgpu {
        return;
    }
    let Some(adapter) = used_adapter() else { return };
    print_note(&format!("wgpu: {adapter}"));
    if adapter.kind == "software" {
        print_warning("this adapter is software on the CPU: `--device flex` is many times faster");
    }
    if compiles {
        print_note(&format!("compiling kernels for {}: the first step may take minutes", adapter.name));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Fails when it is flushed.
    struct Fails(ErrorKind);

    impl Write for Fails {
        fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
            Ok(bytes.len())
        }

        fn flush(&mut self) -> std::io::Result<()> {
            Err(self.0.into())
        }
    }

    #[test]
    fn closed_pipe_is_no_error_but_full_disk_is() {
        assert!(write_result(Fails(ErrorKind::BrokenPipe), "row").is_ok());
        let error = write_result(Fails(ErrorKind::StorageFull), "row").unwrap_err();
        assert_eq!(format!("{error:#}"), "writing to the standard output: no storage space");
        let mut out = Vec::new();
        write_result(&mut out, "key\u{1b}[2J").unwrap();
        assert_eq!(out, b"key\\u{1b}[2J\n");
    }
}
