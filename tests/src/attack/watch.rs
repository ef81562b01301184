//! Ends the process with the number of the execution that hangs.

use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

struct Running {
    target: &'static str,
    seed: u64,
    number: u64,
    since: Instant,
}

static RUNNING: Mutex<Option<Running>> = Mutex::new(None);
static NUMBER: AtomicU64 = AtomicU64::new(0);

pub fn start(most: Duration) {
    std::thread::spawn(move || {
        loop {
            std::thread::sleep(Duration::from_millis(200));
            let Ok(running) = RUNNING.lock() else { continue };
            if let Some(Running { target, seed, number, since }) = &*running
                && since.elapsed() > most
            {
                eprintln!("{target}: execution {number} of seed {seed} hangs for more than {} s", most.as_secs());
                std::process::exit(3);
            }
        }
    });
}

pub fn enter(target: &'static str, seed: u64, number: u64) {
    NUMBER.store(number, Ordering::Relaxed);
    if let Ok(mut running) = RUNNING.lock() {
        *running = Some(Running { target, seed, number, since: Instant::now() });
    }
}

pub fn leave() {
    if let Ok(mut running) = RUNNING.lock() {
        *running = None;
    }
}

/// Ends the process from inside an allocation, where nothing can unwind.
pub fn give_up(what: &str) -> ! {
    eprintln!("execution {} {what}", NUMBER.load(Ordering::Relaxed));
    std::process::abort()
}
