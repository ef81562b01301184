//! The kernels that a computation launches: how often, on how many bytes, for how long.

use std::cell::Cell;
use std::sync::{Arc, Mutex, PoisonError};

use cubecl::MemoryScope;
use cubecl::client::Client;
use cubecl::dry_run::DryRun;
use cubecl::future::block_on;
use cubecl::logging::{LaunchObservation, LaunchObserver, ProfileDuration, TimingMethod, TimingRequest};

thread_local! {
    /// Bytes of the arguments of this thread's next launch.
    static ARGUMENTS: Cell<u64> = const { Cell::new(0) };
    /// Floating-point operations of its products.
    static PRODUCTS: Cell<u64> = const { Cell::new(0) };
}

/// Counts the bytes of an argument of a kernel of this crate, for its launch.
pub(crate) fn count_argument(bytes: usize) {
    ARGUMENTS.set(ARGUMENTS.get() + bytes as u64);
}

/// Counts `count` products of `[rows, terms]` by `[terms, columns]` in the next launch of a kernel of this crate.
pub(crate) fn count_products(count: usize, sizes: [usize; 3]) {
    let multiply_adds = (count as u64) * sizes.map(|size| size as u64).iter().product::<u64>();
    PRODUCTS.set(PRODUCTS.get() + 2 * multiply_adds);
}

/// A launch of a kernel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Launch {
    /// Name of the kernel's type.
    pub kernel: &'static str,
    /// Bytes of the buffers that are its arguments, each once; 0 for kernels of other crates.
    pub bytes: u64,
    /// Floating-point operations of its matrix products; 0 for kernels of other crates.
    pub flops: u64,
    /// Time on the device; `None` without timestamps.
    pub seconds: Option<f64>,
}

struct Observer {
    launches: Mutex<Vec<(Launch, Option<ProfileDuration>)>>,
    timing: TimingRequest,
}

impl Observer {
    fn with<T>(&self, change: impl FnOnce(&mut Vec<(Launch, Option<ProfileDuration>)>) -> T) -> T {
        change(&mut self.launches.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

impl LaunchObserver for Observer {
    fn launched(&self, kernel: &'static str) {
        let launch = Launch { kernel, bytes: ARGUMENTS.take(), flops: PRODUCTS.take(), seconds: None };
        self.with(|launches| launches.push((launch, None)));
    }

    fn timing(&self) -> TimingRequest {
        self.timing
    }

    fn profiled(&self, _kernel: &'static str, profile: ProfileDuration) {
        self.with(|launches| {
            if let Some((_, of_last)) = launches.last_mut() {
                *of_last = Some(profile);
            }
        });
    }
}

/// Runs a computation and returns its result and the kernels that it launches, in order; the whole process is observed. Every
/// launch is timed on the device if `is_timed`. Otherwise the kernels are compiled and not run, and all results are undefined.
pub fn observe<T>(is_timed: bool, run: impl FnOnce() -> T) -> (T, Vec<Launch>) {
    let timing = if is_timed { TimingRequest::Deferred } else { TimingRequest::None };
    let observer = Arc::new(Observer { launches: Mutex::default(), timing });
    let dry_run = (!is_timed).then(DryRun::new);
    ARGUMENTS.set(0);
    PRODUCTS.set(0);
    let observing = LaunchObservation::new(Arc::<Observer>::clone(&observer));
    let result = run();
    drop(observing);
    drop(dry_run);
    let launches = observer.with(std::mem::take).into_iter().map(|(launch, profile)| {
        let profile = profile.filter(|profile| profile.timing_method() == TimingMethod::Device);
        let ticks = profile.and_then(|profile| block_on(profile.resolve()));
        Launch { seconds: ticks.map(|ticks| ticks.duration().as_secs_f64()), ..launch }
    });
    (result, launches.collect())
}

/// Returns the bytes that the allocator holds on the device.
pub fn reserved_bytes(client: &Client) -> u64 {
    client.memory_report(MemoryScope::Device).usage().bytes_reserved
}
