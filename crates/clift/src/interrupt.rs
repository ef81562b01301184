//! Ctrl-C, SIGTERM and SIGHUP: the first signal requests a stop after the present step, a later one ends the process. Both print
//! a line.

use std::io::{IsTerminal, stderr};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicI32, AtomicU64, Ordering};
use std::time::Instant;

use anyhow::Context;
use signal_hook::consts::{SIGINT, SIGTERM};
use signal_hook::low_level;

use crate::verbosity::Verbosity;

/// Offset of exit codes of signals, as in shells.
const SIGNALLED: i32 = 128;
/// Signals within this time after the first belong to it: GNU `timeout` signals the process and then its group.
const REPEAT_MS: u64 = 1000;

/// Number of the first signal; 0 for none.
static FIRST_SIGNAL: AtomicI32 = AtomicI32::new(0);

/// What a command does on its signals, for the lines that they print.
#[derive(Clone, Copy, Debug)]
pub struct Ending {
    /// What the first signal waits for.
    pub first: &'static str,
    /// What a second one loses.
    pub second: &'static str,
}

impl Ending {
    /// A command without intermediate results.
    pub const WITHOUT_RESULTS: Self = Self {
        first: "finishing this step; Ctrl-C again ends at once\n",
        second: "ended before this step was finished; no output files were written\n",
    };
    /// A training run.
    pub const RUN: Self = Self {
        first: "finishing this step and saving; Ctrl-C again ends without saving\n",
        second: "ended without saving; the same command resumes from the last checkpoint\n",
    };
}

/// Listens for signals and returns a flag that the first one sets.
pub fn flag(ending: Ending) -> anyhow::Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    let started = Instant::now();
    let first_ms = Arc::new(AtomicU64::new(u64::MAX));
    let is_silent = Verbosity::chosen() == Verbosity::Silent;
    // A terminal has `^C` in this line.
    let start = if stderr().is_terminal() { "\n" } else { "" };
    let print = move |text: &'static str| {
        for text in [start, text].into_iter().filter(|_| !is_silent) {
            // SAFETY: the pointer and the length are those of a string that lives as long as the process. The lock of the
            // standard error is not taken: the interrupted thread may have it.
            let _ = unsafe { libc::write(2, text.as_ptr().cast(), text.len() as _) };
        }
    };
    let listen = |signal: i32| {
        let (stop, first_ms) = (stop.clone(), first_ms.clone());
        let handle = move || {
            let now_ms = started.elapsed().as_millis() as u64;
            match first_ms.compare_exchange(u64::MAX, now_ms, Ordering::SeqCst, Ordering::SeqCst) {
                Ok(_) => {
                    FIRST_SIGNAL.store(signal, Ordering::SeqCst);
                    stop.store(true, Ordering::SeqCst);
                    print(ending.first);
                }
                Err(first_ms) if now_ms.saturating_sub(first_ms) < REPEAT_MS => {}
                Err(_) => {
                    print(ending.second);
                    low_level::exit(SIGNALLED + signal)
                }
            }
        };
        // SAFETY: the handler reads the clock, writes atomics and calls `write` and `_exit`, which are async-signal-safe; it
        // neither allocates, locks nor panics.
        unsafe { low_level::register(signal, handle) }.context("listening for signals")
    };
    for signal in [SIGINT, SIGTERM] {
        listen(signal)?;
    }
    #[cfg(unix)]
    if !is_ignored(signal_hook::consts::SIGHUP) {
        listen(signal_hook::consts::SIGHUP)?;
    }
    Ok(stop)
}

/// Returns the exit code of an interrupted process: 128 plus the number of the first signal, or of Ctrl-C.
pub fn exit_code() -> u8 {
    let signal = match FIRST_SIGNAL.load(Ordering::SeqCst) {
        0 => SIGINT,
        signal => signal,
    };
    (SIGNALLED + signal) as u8
}

/// Returns whether the process ignores a signal from its start, as `nohup` sets for SIGHUP.
#[cfg(unix)]
fn is_ignored(signal: i32) -> bool {
    // SAFETY: all bits zero is a valid `sigaction`, and the call only writes the present one to it.
    unsafe {
        let mut present: libc::sigaction = std::mem::zeroed();
        libc::sigaction(signal, std::ptr::null(), &raw mut present) == 0 && present.sa_sigaction == libc::SIG_IGN
    }
}
