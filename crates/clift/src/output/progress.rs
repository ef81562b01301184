//! Choose a progress bar or progress lines.

use std::io::IsTerminal;

use clift_train::Sink;

use crate::output::bar::Bar;
use crate::output::plain::PlainLines;

/// Creates a progress bar if the standard error is a terminal, progress lines otherwise.
pub fn progress_sink() -> Box<dyn Sink> {
    if std::io::stderr().is_terminal() {
        Box::new(Bar::default())
    } else {
        Box::new(PlainLines::new(std::io::stderr()))
    }
}
