//! Ctrl-C, SIGTERM and SIGHUP: the first signal requests a stop after the state is saved, the second ends the process.

use std::sync::atomic::{AtomicBool, AtomicUsize};
use std::sync::{Arc, OnceLock};

use anyhow::Context;
use signal_hook::consts::{SIGINT, SIGTERM};
use signal_hook::flag;

/// Offset of exit codes of signals, as in shells.
const SIGNALLED: u8 = 128;

/// Number of the last signal; 0 for none.
static LAST_SIGNAL: OnceLock<Arc<AtomicUsize>> = OnceLock::new();

/// Listens for signals and returns a flag that the first one sets.
pub fn flag() -> anyhow::Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    let last = LAST_SIGNAL.get_or_init(Arc::default);
    let listen = |signal: i32| {
        // The shutdown is registered before the flag: it must only see a flag that an earlier signal has set.
        flag::register_conditional_shutdown(signal, i32::from(SIGNALLED) + signal, stop.clone())?;
        flag::register_usize(signal, last.clone(), signal as usize)?;
        flag::register(signal, stop.clone())
    };
    for signal in [SIGINT, SIGTERM] {
        listen(signal).context("listening for signals")?;
    }
    #[cfg(unix)]
    if !is_ignored(signal_hook::consts::SIGHUP) {
        listen(signal_hook::consts::SIGHUP).context("listening for signals")?;
    }
    Ok(stop)
}

/// Returns the exit code of an interrupted process: 128 plus the number of the signal.
pub fn exit_code() -> u8 {
    let last = LAST_SIGNAL.get().map_or(0, |last| last.load(std::sync::atomic::Ordering::SeqCst));
    SIGNALLED + u8::try_from(last).ok().filter(|last| *last != 0).unwrap_or(SIGINT as u8)
}

/// Returns whether the process ignores a signal from its start, as `nohup` sets for SIGHUP. Linux only; `false` elsewhere.
#[cfg(unix)]
fn is_ignored(signal: i32) -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    ignores(&status, signal)
}

#[cfg(unix)]
fn ignores(status: &str, signal: i32) -> bool {
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok()).is_some_and(|mask| mask >> (signal - 1) & 1 == 1)
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;

    #[test]
    fn ignored_signals_are_read_from_the_mask() {
        let status = "Name:\tclift\nSigBlk:\tffffffffffffffff\nSigIgn:\t0000000000001001\nSigCgt:\t0\n";
        assert!(ignores(status, 1) && ignores(status, 13));
        assert!(!ignores(status, 2) && !ignores("", 1));
    }

    #[test]
    fn exit_code_without_a_signal_is_that_of_ctrl_c() {
        assert_eq!(exit_code(), 130);
    }
}
