//! The threads that compute.

use std::thread::available_parallelism;

use rayon::ThreadPoolBuilder;

/// Environment variable with the number of threads.
const VARIABLE: &str = "RAYON_NUM_THREADS";

/// Starts the threads: as many as [`VARIABLE`] says, else `count`, else one per core. The main thread is one of them: it works
/// where it would wait for another thread to wake up. Has no effect once threads are there.
pub fn start(count: Option<usize>) {
    let chosen = std::env::var(VARIABLE).ok().and_then(|text| text.parse().ok()).filter(|&count| count > 0);
    let count = chosen.or(count).unwrap_or_else(|| available_parallelism().map_or(1, usize::from));
    let threads = ThreadPoolBuilder::new().num_threads(count);
    // A single thread has to be another: the main thread waits for loaders, which wait for the threads.
    let threads = if count > 1 { threads.use_current_thread() } else { threads };
    drop(threads.build_global());
}
