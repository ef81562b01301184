//! Items made ahead by background threads, delivered in step order.

use std::ops::Range;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, sync_channel};
use std::thread::JoinHandle;

use crate::error::WorkerPanic;

type Make<T, E> = dyn Fn(u64) -> Result<T, E> + Send + Sync;

/// An iterator over `make(step)` for consecutive steps, computed ahead by background threads.
///
/// Items come in step order. If `make` is a pure function, the items depend neither on the number of threads nor on the
/// first step. At most `depth` items beyond those taken are finished or in progress. Errors, and panics in `make` (as
/// [`WorkerPanic`]), are delivered at their step; iteration may continue. Dropping the iterator waits for the items in
/// progress, at most one per thread.
pub struct Prefetcher<T, E> {
    make: Arc<Make<T, E>>,
    start_step: u64,
    steps: Range<u64>,
    /// Lane `i` of `n` makes the steps `start_step + i`, `start_step + i + n`, ..; `None` makes them when they are taken.
    lanes: Vec<Option<Lane<T, E>>>,
}

struct Lane<T, E> {
    items: Receiver<Result<T, E>>,
    worker: JoinHandle<()>,
}

impl<T, E> Prefetcher<T, E>
where
    T: Send + 'static,
    E: From<WorkerPanic> + Send + 'static,
{
    /// Starts to compute the items of `start_step..end_step`.
    ///
    /// With `threads = 0`, `make` runs in the iterating thread. `depth`, at least 1, bounds the items in memory and the
    /// number of threads. The iterating thread computes the items of a thread that the operating system refuses.
    pub fn new(
        make: impl Fn(u64) -> Result<T, E> + Send + Sync + 'static,
        start_step: u64,
        end_step: u64,
        threads: usize,
        depth: usize,
    ) -> Self {
        let make: Arc<Make<T, E>> = Arc::new(make);
        let depth = depth.max(1);
        let num_lanes = threads.clamp(1, depth);
        let lane = |index: usize| {
            let make = Arc::clone(&make);
            // A lane has one item in progress and the others of its share of `depth` in the channel.
            let (sender, items) = sync_channel((depth - 1 - index) / num_lanes);
            let run = move || {
                let steps = (start_step.saturating_add(index as u64)..end_step).step_by(num_lanes);
                // Ends when the iterator is dropped, which closes the channel.
                steps.map(|step| make_caught(&*make, step)).try_for_each(|item| sender.send(item).ok());
            };
            let worker = std::thread::Builder::new().name("clift-loader".into()).spawn(run).ok()?;
            Some(Lane { items, worker })
        };
        let lanes = (0..num_lanes).map(|index| (threads > 0).then(|| lane(index)).flatten()).collect();
        Self { make, start_step, steps: start_step..end_step, lanes }
    }
}

impl<T, E: From<WorkerPanic>> Iterator for Prefetcher<T, E> {
    type Item = Result<T, E>;

    fn next(&mut self) -> Option<Self::Item> {
        let step = self.steps.next()?;
        let lane = (step - self.start_step) % self.lanes.len() as u64;
        let made = self.lanes[lane as usize].as_ref().and_then(|lane| lane.items.recv().ok());
        Some(made.unwrap_or_else(|| make_caught(&*self.make, step)))
    }
}

fn make_caught<T, E: From<WorkerPanic>>(make: &Make<T, E>, step: u64) -> Result<T, E> {
    // `make` is shared behind `&`, and a partial result is discarded: no inconsistent state is visible.
    catch_unwind(AssertUnwindSafe(|| make(step))).unwrap_or_else(|panic| {
        let message = panic
            .downcast_ref::<&str>()
            .map(ToString::to_string)
            .or_else(|| panic.downcast_ref::<String>().cloned())
            .unwrap_or_else(|| "no message".into());
        Err(WorkerPanic { step, message }.into())
    })
}

impl<T, E> Drop for Prefetcher<T, E> {
    fn drop(&mut self) {
        // All channels are closed before the first thread is awaited.
        let workers: Vec<JoinHandle<()>> = self.lanes.drain(..).flatten().map(|lane| lane.worker).collect();
        for worker in workers {
            // A worker catches panics of `make`; a failed join leaves nothing to clean up.
            let _ = worker.join();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::{AtomicU64, Ordering};
    use std::sync::mpsc;
    use std::time::Duration;

    #[derive(Debug, PartialEq)]
    enum Failure {
        Bad(u64),
        Panicked(WorkerPanic),
    }

    impl From<WorkerPanic> for Failure {
        fn from(panic: WorkerPanic) -> Self {
            Self::Panicked(panic)
        }
    }

    /// Items that take unequal times, so that threads finish them out of order.
    fn slow_square(step: u64) -> u64 {
        std::thread::sleep(Duration::from_micros(step * 7919 % 5 * 200));
        step * step
    }

    fn squares(start: u64, end: u64, threads: usize, depth: usize) -> Prefetcher<u64, Failure> {
        Prefetcher::new(|step| Ok(slow_square(step)), start, end, threads, depth)
    }

    /// Fails the test after 20 seconds instead of blocking.
    fn within_seconds<T: Send + 'static>(compute: impl FnOnce() -> T + Send + 'static) -> T {
        let (sender, receiver) = mpsc::channel();
        std::thread::spawn(move || sender.send(compute()));
        receiver.recv_timeout(Duration::from_secs(20)).expect("finished in time")
    }

    #[test]
    fn items_are_in_step_order_with_any_number_of_threads() {
        for (start, end) in [(17, 60), (5, 5), (6, 5)] {
            let expected: Vec<_> = (start..end).map(|step| Ok(step * step)).collect();
            for (threads, depth) in [(0, 1), (1, 1), (1, 4), (3, 2), (3, 8), (3, 0)] {
                let items = within_seconds(move || squares(start, end, threads, depth).collect::<Vec<_>>());
                assert_eq!(items, expected, "{threads} threads, depth {depth}");
            }
        }
    }

    #[test]
    fn errors_and_panics_come_at_their_step() {
        let make = |step| match step {
            3 => Err(Failure::Bad(3)),
            5 => panic!("boom at {step}"),
            _ => Ok(step),
        };
        let panicked = Failure::Panicked(WorkerPanic { step: 5, message: "boom at 5".into() });
        let expected = [Ok(0), Ok(1), Ok(2), Err(Failure::Bad(3)), Ok(4), Err(panicked), Ok(6)];
        for threads in [0, 1, 3] {
            let items = within_seconds(move || Prefetcher::new(make, 0, 7, threads, 2).collect::<Vec<_>>());
            assert_eq!(items, expected, "{threads} threads");
        }
    }

    #[test]
    fn at_most_depth_items_are_made_ahead() {
        let made = Arc::new(AtomicU64::new(0));
        let counter = Arc::clone(&made);
        let make = move |step| {
            counter.fetch_add(1, Ordering::SeqCst);
            Ok::<_, Failure>(step)
        };
        let mut items = Prefetcher::new(make, 0, 1_000, 3, 5);
        for taken in 0..20 {
            let deadline = std::time::Instant::now() + Duration::from_secs(20);
            while made.load(Ordering::SeqCst) < taken + 5 {
                assert!(std::time::Instant::now() < deadline, "fewer than depth items are made ahead");
                std::thread::yield_now();
            }
            std::thread::sleep(Duration::from_millis(2));
            assert_eq!(made.load(Ordering::SeqCst), taken + 5);
            assert_eq!(items.next(), Some(Ok(taken)));
        }
    }
}
