//! Progress of counted work outside training.

use std::io::IsTerminal;
use std::time::{Duration, Instant};

use indicatif::ProgressBar;

use crate::output::bar::progress_bar;
use crate::output::stdout::print_note;
use crate::output::units::{duration, rate};
use crate::output::visible::visible;
use crate::verbosity::Verbosity;

const INTERVAL_S: f64 = 10.0;

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
        let has_bar = std::io::stderr().is_terminal() && Verbosity::chosen() != Verbosity::Quiet;
        let bar = has_bar.then(|| progress_bar(name, 0, total));
        let now = Instant::now();
        Self { name: name.into(), total, bar, started: now, last_line: now }
    }

    pub fn set(&mut self, done: u64) {
        match &self.bar {
            Some(bar) => bar.set_position(done),
            None if self.last_line.elapsed().as_secs_f64() >= INTERVAL_S => {
                self.last_line = Instant::now();
                let line = line(&self.name, done, self.total, self.started.elapsed().as_secs_f64());
                print_note(&line);
            }
            None => {}
        }
    }

    pub fn note(&self, line: &str) {
        match &self.bar {
            Some(bar) => bar.println(visible(line)),
            None => print_note(line),
        }
    }
}

impl Drop for Counter {
    fn drop(&mut self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}

/// A counter of the examined chunks of a data set, shown if the scan takes longer than half a second, as the first one does.
#[derive(Default)]
pub struct ScanCounter {
    /// Start of the scan, and the counter once it is shown.
    scan: Option<(Instant, Option<Counter>)>,
}

impl ScanCounter {
    pub fn set(&mut self, done: usize, total: usize) {
        let (started, shown) = self.scan.get_or_insert_with(|| (Instant::now(), None));
        if started.elapsed() > SCAN_DELAY {
            shown.get_or_insert_with(|| Counter::new("chunks", total as u64)).set(done as u64);
        }
        if done == total {
            self.scan = None;
        }
    }
}

const SCAN_DELAY: Duration = Duration::from_millis(500);

fn line(name: &str, done: u64, total: u64, elapsed_s: f64) -> String {
    let per_s = done.max(1) as f64 / elapsed_s.max(1e-9);
    let left_s = total.saturating_sub(done) as f64 / per_s;
    format!("{name} {done}/{total}  {}, {} left", rate(per_s), duration(left_s))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn line_has_mean_rate_and_time_left() {
        assert_eq!(line("train", 40, 100, 10.0), "train 40/100  4.0/s, 15 s left");
        assert_eq!(line("train", 0, 100, 0.0), line("train", 0, 100, 1e-9));
    }
}
