//! Progress of counted work outside training.

use std::io::{IsTerminal, stderr};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressFinish, ProgressStyle};

use crate::output::stdout::print_note;
use crate::output::units::{duration, rate};
use crate::verbosity::Verbosity;

const INTERVAL: Duration = Duration::from_secs(10);
const SCAN_DELAY: Duration = Duration::from_millis(500);

/// Whether progress is a bar: on a terminal, without `--quiet`.
pub fn has_bar() -> bool {
    stderr().is_terminal() && Verbosity::chosen() == Verbosity::Normal
}

/// Creates a bar before a message, which is cut at the end of the line: a wrapped bar would leave copies of itself behind.
pub fn bar(total: u64) -> ProgressBar {
    let style = ProgressStyle::with_template("{bar:8.cyan/dim} {wide_msg}").expect("a valid template");
    ProgressBar::new(total).with_style(style)
}

/// A counter of finished items: a bar on a terminal, a line every ten seconds elsewhere.
pub struct Counter {
    name: String,
    total: u64,
    bar: Option<ProgressBar>,
    started: Instant,
    last_line: Instant,
}

impl Counter {
    pub fn new(name: &str, total: u64) -> Self {
        let now = Instant::now();
        let bar = has_bar().then(|| bar(total).with_finish(ProgressFinish::AndClear));
        Self { name: name.into(), total, bar, started: now, last_line: now }
    }

    pub fn set(&mut self, done: u64) {
        let line = || {
            let per_s = done.max(1) as f64 / self.started.elapsed().as_secs_f64().max(1e-9);
            let left_s = self.total.saturating_sub(done) as f64 / per_s;
            format!("{} {done}/{}  {}, {} left", self.name, self.total, rate(per_s), duration(left_s))
        };
        match &self.bar {
            Some(bar) => {
                bar.set_message(line());
                bar.set_position(done);
            }
            None if self.last_line.elapsed() >= INTERVAL => {
                print_note(&line());
                self.last_line = Instant::now();
            }
            None => {}
        }
    }
}

/// Returns a counter of the examined chunks of data sets, shown when a scan takes longer than half a second.
pub fn scan_counter() -> impl FnMut(usize, usize) {
    let mut scan: Option<(Instant, Option<Counter>)> = None;
    move |done, total| {
        let (started, shown) = scan.get_or_insert_with(|| (Instant::now(), None));
        if started.elapsed() > SCAN_DELAY {
            shown.get_or_insert_with(|| Counter::new("chunks", total as u64)).set(done as u64);
        }
        if done == total {
            scan = None;
        }
    }
}
