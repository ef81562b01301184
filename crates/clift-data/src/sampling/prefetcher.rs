//! Items made ahead by background threads, delivered in step order.

use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
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
    shared: Arc<Shared<T, E>>,
    workers: Vec<JoinHandle<()>>,
    next_step: u64,
}

struct Shared<T, E> {
    make: Box<Make<T, E>>,
    end_step: u64,
    depth: u64,
    queue: Mutex<Queue<T, E>>,
    /// Signalled when an item is finished.
    finished: Condvar,
    /// Signalled when an item is taken, and at shutdown.
    taken: Condvar,
}

struct Queue<T, E> {
    /// Finished items by step.
    items: BTreeMap<u64, Result<T, E>>,
    /// First step that no thread has started.
    unstarted: u64,
    /// Next step of the consumer.
    consumed: u64,
    closed: bool,
}

impl<T, E> Prefetcher<T, E>
where
    T: Send + 'static,
    E: From<WorkerPanic> + Send + 'static,
{
    /// Starts to compute the items of `start_step..end_step`.
    ///
    /// With `threads = 0`, `make` runs in the iterating thread. `depth`, at least 1, bounds the items in memory and the
    /// number of threads. If the operating system refuses a thread, the others compute the same items.
    pub fn new(
        make: impl Fn(u64) -> Result<T, E> + Send + Sync + 'static,
        start_step: u64,
        end_step: u64,
        threads: usize,
        depth: usize,
    ) -> Self {
        let depth = depth.max(1);
        let queue = Queue { items: BTreeMap::new(), unstarted: start_step, consumed: start_step, closed: false };
        let shared = Arc::new(Shared {
            make: Box::new(make),
            end_step,
            depth: depth as u64,
            queue: Mutex::new(queue),
            finished: Condvar::new(),
            taken: Condvar::new(),
        });
        let workers = (0..threads.min(depth))
            .filter_map(|_| {
                let shared = Arc::clone(&shared);
                std::thread::Builder::new().name("clift-loader".into()).spawn(move || shared.run_worker()).ok()
            })
            .collect();
        Self { shared, workers, next_step: start_step }
    }
}

impl<T, E: From<WorkerPanic>> Iterator for Prefetcher<T, E> {
    type Item = Result<T, E>;
    fn next(&mut self) -> Option<Self::Item> {
        let step = self.next_step;
        if step >= self.shared.end_step {
            return None;
        }
        self.next_step += 1;
        if self.workers.is_empty() {
            return Some(self.shared.make_caught(step));
        }
        let mut queue = self.shared.lock();
        loop {
            if let Some(item) = queue.items.remove(&step) {
                queue.consumed = self.next_step;
                self.shared.taken.notify_all();
                return Some(item);
            }
            queue = self.shared.finished.wait(queue).unwrap_or_else(PoisonError::into_inner);
        }
    }
}

impl<T, E: From<WorkerPanic>> Shared<T, E> {
    /// Computes the next step while fewer than `depth` items are waiting, until the end or shutdown.
    fn run_worker(&self) {
        let mut queue = self.lock();
        while !queue.closed && queue.unstarted < self.end_step {
            if queue.unstarted >= queue.consumed.saturating_add(self.depth) {
                queue = self.taken.wait(queue).unwrap_or_else(PoisonError::into_inner);
                continue;
            }
            let step = queue.unstarted;
            queue.unstarted += 1;
            drop(queue);
            let item = self.make_caught(step);
            queue = self.lock();
            queue.items.insert(step, item);
            self.finished.notify_all();
        }
    }

    fn make_caught(&self, step: u64) -> Result<T, E> {
        // `make` is shared behind `&`, and a partial result is discarded: no inconsistent state is visible.
        catch_unwind(AssertUnwindSafe(|| (self.make)(step))).unwrap_or_else(|panic| {
            let message = panic
                .downcast_ref::<&str>()
                .map(ToString::to_string)
                .or_else(|| panic.downcast_ref::<String>().cloned())
                .unwrap_or_else(|| "no message".into());
            Err(WorkerPanic { step, message }.into())
        })
    }
}

impl<T, E> Shared<T, E> {
    /// Locks the queue. No user code runs under the lock, so even a poisoned queue is consistent.
    fn lock(&self) -> MutexGuard<'_, Queue<T, E>> {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<T, E> Drop for Prefetcher<T, E> {
    fn drop(&mut self) {
        self.shared.lock().closed = true;
        self.shared.taken.notify_all();
        for worker in self.workers.drain(..) {
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
        let expected: Vec<_> = (17..60).map(|step| Ok(step * step)).collect();
        for (threads, depth) in [(0, 1), (1, 1), (1, 4), (3, 2), (3, 8), (3, 0)] {
            let items = within_seconds(move || squares(17, 60, threads, depth).collect::<Vec<_>>());
            assert_eq!(items, expected, "{threads} threads, depth {depth}");
        }
    }

    #[test]
    fn empty_range_has_no_items() {
        for threads in [0, 2] {
            assert_eq!(squares(5, 5, threads, 2).count(), 0);
            assert_eq!(squares(6, 5, threads, 2).count(), 0);
        }
    }

    #[test]
    fn errors_and_panics_come_at_their_step() {
        let make = |step| match step {
            3 => Err(Failure::Bad(3)),
            5 => panic!("boom at {step}"),
            _ => Ok(step),
        };
        let expected = vec![
            Ok(0),
            Ok(1),
            Ok(2),
            Err(Failure::Bad(3)),
            Ok(4),
            Err(Failure::Panicked(WorkerPanic { step: 5, message: "boom at 5".into() })),
            Ok(6),
        ];
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

    #[test]
    fn dropping_a_full_prefetcher_ends_its_threads() {
        let alive = Arc::new(());
        let inside = Arc::clone(&alive);
        let make = move |step| {
            assert!(Arc::strong_count(&inside) > 0);
            Ok::<_, Failure>(step)
        };
        let mut items = Prefetcher::new(make, 0, u64::MAX, 3, 2);
        assert_eq!(items.next(), Some(Ok(0)));
        within_seconds(move || drop(items));
        assert_eq!(Arc::strong_count(&alive), 1, "a thread still holds the closure");
    }
}
