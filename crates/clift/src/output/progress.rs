//! Choose bar or lines.

use std::io::IsTerminal;

use clift_train::Sink;

use crate::output::bar::Bar;
use crate::output::plain::PlainLines;

/// Chooses the sink that suits the standard error stream of this process.
pub fn sink() -> Box<dyn Sink> {
    if std::io::stderr().is_terminal() {
        Box::new(Bar::default())
    } else {
        Box::new(PlainLines::new(std::io::stderr()))
    }
}
