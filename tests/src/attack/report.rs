//! Results of an attack.

use std::fmt::Write as _;
use std::time::Duration;

/// Findings after which the attack of a reader stops.
pub const MOST_FINDINGS: usize = 20;

/// Longest error message in bytes: people read it.
pub const MOST_MESSAGE: usize = 20_000;

#[derive(Debug, Default)]
pub struct Attacked {
    pub name: &'static str,
    pub executions: u64,
    pub accepted: u64,
    pub slowest: Duration,
    pub peak_bytes: usize,
    pub seconds: f64,
    /// Findings, each once.
    pub findings: Vec<String>,
}

impl Attacked {
    pub fn find(&mut self, what: String, saved: Option<String>) {
        if self.findings.iter().all(|known| !known.starts_with(&what)) {
            self.findings.push(saved.map_or(what.clone(), |saved| format!("{what} ({saved})")));
        }
    }

    pub fn line(&self) -> String {
        let Self { name, executions, accepted, slowest, peak_bytes, seconds, findings } = self;
        let mut line = format!(
            "{name}: {executions} executions in {seconds:.0} s, {accepted} accepted, slowest {:.1} ms, peak {:.1} MiB",
            slowest.as_secs_f64() * 1e3,
            *peak_bytes as f64 / f64::from(1 << 20)
        );
        for finding in findings {
            let _ = write!(line, "\n  FOUND: {finding}");
        }
        line
    }
}
