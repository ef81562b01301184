//! The threads that compute.

use std::thread::{Builder, available_parallelism};

use rayon::{ThreadBuilder, ThreadPoolBuilder};

/// Environment variable with the number of threads.
const VARIABLE: &str = "RAYON_NUM_THREADS";

/// Starts the threads: as many as [`VARIABLE`] says, else `count`, else one per core. The main thread is one of them: it works
/// where it would wait for another thread to wake up. Has no effect once threads are there.
pub fn start(count: Option<usize>) {
    let chosen = std::env::var(VARIABLE).ok().and_then(|text| text.parse().ok()).filter(|&count| count > 0);
    let count = chosen.or(count).unwrap_or_else(|| available_parallelism().map_or(1, usize::from));
    let threads = ThreadPoolBuilder::new().num_threads(count).spawn_handler(|thread| spawn(thread).map(drop));
    // A single thread has to be another: the main thread waits for loaders, which wait for the threads.
    let threads = if count > 1 { threads.use_current_thread() } else { threads };
    drop(threads.build_global());
}

fn spawn(thread: ThreadBuilder) -> std::io::Result<std::thread::JoinHandle<()>> {
    Builder::new().spawn(|| flush_subnormals(|| thread.run()))
}

/// Calls `compute` with subnormal numbers (below 1.2e-38 in f32) read and written as zeros, on this thread and, on Linux, on the
/// threads that it starts. A trained network has many of them, and they are slow on some processors: on an Intel Xeon (family 6
/// model 207), resuming a run at step 775, an update took 5.2 s with them and 1.2 s without.
pub fn flush_subnormals<T>(compute: impl FnOnce() -> T) -> T {
    // SAFETY: the compiler may compute constants with subnormal numbers that the processor would make zeros. Nothing here
    // depends on which of the two it is.
    unsafe { no_denormals::no_denormals(compute) }
}

#[cfg(test)]
mod tests {
    use std::hint::black_box;

    use super::*;

    #[test]
    fn subnormal_numbers_are_zeros_on_every_thread_and_only_inside() {
        let half = || black_box(f32::MIN_POSITIVE) * 0.5;
        assert_eq!(flush_subnormals(half), 0.0);
        assert!(half() > 0.0);

        let threads = ThreadPoolBuilder::new().num_threads(2).spawn_handler(|thread| spawn(thread).map(drop)).build();
        let halves = threads.expect("two threads start").broadcast(|_| half());
        assert_eq!(halves, [0.0; 2]);
    }
}
