//! The receiver of a run's events for the verbosity of the process.

use std::io::{IsTerminal, stderr};

use clift_train::{Event, Sink};

use crate::output::bar::Bar;
use crate::output::counter::ScanCounter;
use crate::output::plain::{INTERVAL_S, PlainLines};
use crate::output::stdout::print_warning;
use crate::verbosity::Verbosity;

/// Creates a progress bar if the standard error is a terminal, progress lines otherwise; warnings alone for `--quiet`, and
/// a line for every step for `--verbose`.
pub fn progress_sink() -> Box<dyn Sink> {
    match Verbosity::chosen() {
        Verbosity::Silent => Box::new(|_: &Event| {}),
        Verbosity::Quiet => Box::new(|event: &Event| {
            if let Event::Warning(text) = event {
                print_warning(text);
            }
        }),
        Verbosity::Verbose => with_scans(PlainLines::new(stderr(), 0.0)),
        Verbosity::Normal if stderr().is_terminal() => with_scans(Bar::default()),
        Verbosity::Normal => with_scans(PlainLines::new(stderr(), INTERVAL_S)),
    }
}

/// Shows scans of data sets by a counter of their own.
fn with_scans(mut sink: impl Sink + 'static) -> Box<dyn Sink> {
    let mut counter = ScanCounter::default();
    Box::new(move |event: &Event| match event {
        Event::Scan { done, total } => counter.set(*done, *total),
        _ => sink.event(event),
    })
}
