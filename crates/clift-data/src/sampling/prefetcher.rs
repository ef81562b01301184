//! Batches ahead of time, in step order, the same whatever the number of threads.

use std::collections::BTreeMap;
use std::fmt;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;

use crate::error::WorkerPanic;

type Make<T, E> = dyn Fn(u64) -> Result<T, E> + Send + Sync;

/// Iterates over what `make(step)` gives for consecutive steps, made by background threads.
///
/// Items come strictly in step order. Where `make` is a pure function of its step, so is the sequence: neither the
/// number of threads nor where a run resumes changes an item. At most `depth` items are finished or being made
/// beyond those handed out. An error, or a panic in `make` (as a [`WorkerPanic`]), comes at its step; iteration may
/// continue after it. Dropping the iterator waits for the items being made, at most one per thread.
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
    /// Signalled when an item is handed out, or at shutdown.
    wanted: Condvar,
}

struct Queue<T, E> {
    /// Finished items by step.
    items: BTreeMap<u64, Result<T, E>>,
    /// First step no thread has taken.
    untaken: u64,
    /// Step the consumer takes next.
    consumed: u64,
    closed: bool,
}

impl<T, E> Prefetcher<T, E>
where
    T: Send + 'static,
    E: From<WorkerPanic> + Send + 'static,
{
    /// Starts making the items of `start_step..end_step`.
    ///
    /// With `threads = 0`, `make` runs in the thread that iterates, one item at a time. `depth` is the most items
    /// held or being made at any time, at least 1; more threads than that would idle, so no more are started. Where
    /// the operating system refuses a thread, fewer do the work: the items are the same.
    pub fn new(
        make: impl Fn(u64) -> Result<T, E> + Send + Sync + 'static,
        start_step: u64,
        end_step: u64,
        threads: usize,
        depth: usize,
    ) -> Self {
        let depth = depth.max(1);
        let queue = Queue { items: BTreeMap::new(), untaken: start_step, consumed: start_step, closed: false };
        let shared = Arc::new(Shared {
            make: Box::new(make),
            end_step,
            depth: depth as u64,
            queue: Mutex::new(queue),
            finished: Condvar::new(),
            wanted: Condvar::new(),
        });
        let workers = (0..threads.min(depth))
            .filter_map(|_| {
                let shared = Arc::clone(&shared);
                std::thread::Builder::new().name("clift-loader".into()).spawn(move || shared.work()).ok()
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
                self.shared.wanted.notify_all();
                return Some(item);
            }
            queue = self.shared.finished.wait(queue).unwrap_or_else(PoisonError::into_inner);
        }
    }

    fn size_hint(&self) -> (usize, Option<usize>) {
        let left = usize::try_from(self.shared.end_step.saturating_sub(self.next_step)).ok();
        (left.unwrap_or(usize::MAX), left)
    }
}

impl<T, E: From<WorkerPanic>> Shared<T, E> {
    /// What a worker thread does: takes the next step while there is room, until the end or shutdown.
    fn work(&self) {
        let mut queue = self.lock();
        while !queue.closed && queue.untaken < self.end_step {
            if queue.untaken >= queue.consumed.saturating_add(self.depth) {
                queue = self.wanted.wait(queue).unwrap_or_else(PoisonError::into_inner);
                continue;
            }
            let step = queue.untaken;
            queue.untaken += 1;
            drop(queue);
            let item = self.make_caught(step);
            queue = self.lock();
            queue.items.insert(step, item);
            self.finished.notify_all();
        }
    }

    fn make_caught(&self, step: u64) -> Result<T, E> {
        // `make` is only shared behind `&`, and what it returned is discarded: nothing half-changed is seen.
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
    /// No user code runs under the lock, so even a poisoned queue is whole.
    fn lock(&self) -> MutexGuard<'_, Queue<T, E>> {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<T, E> Drop for Prefetcher<T, E> {
    fn drop(&mut self) {
        self.shared.lock().closed = true;
        self.shared.wanted.notify_all();
        for worker in self.workers.drain(..) {
            // A worker catches what it runs; should it die all the same, there is nothing left to save.
            let _ = worker.join();
        }
    }
}

impl<T, E> fmt::Debug for Prefetcher<T, E> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Prefetcher")
            .field("next_step", &self.next_step)
            .field("end_step", &self.shared.end_step)
            .field("threads", &self.workers.len())
            .finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicU64, Ordering};
    use std::sync::mpsc;
    use std::time::Duration;

    use super::*;

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

    /// Fails the test, instead of hanging it, when `work` does not come back.
    fn within_seconds<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> T {
        let (sender, receiver) = mpsc::channel();
        std::thread::spawn(move || sender.send(work()));
        receiver.recv_timeout(Duration::from_secs(20)).expect("finished in time")
    }

    #[test]
    fn items_come_in_step_order_whatever_the_number_of_threads() {
        let expected: Vec<_> = (0..60).map(|step| Ok(step * step)).collect();
        for (threads, depth) in [(0, 1), (1, 1), (1, 4), (3, 2), (3, 8), (3, 0)] {
            let items = within_seconds(move || squares(0, 60, threads, depth).collect::<Vec<_>>());
            assert_eq!(items, expected, "{threads} threads, depth {depth}");
        }
    }

    #[test]
    fn a_start_at_a_later_step_gives_the_tail() {
        for threads in [0, 3] {
            let whole: Vec<_> = squares(0, 30, threads, 4).collect();
            let tail: Vec<_> = squares(17, 30, threads, 4).collect();
            assert_eq!(whole[17..], tail[..]);
        }
    }

    #[test]
    fn an_empty_range_gives_nothing() {
        for threads in [0, 2] {
            assert_eq!(squares(5, 5, threads, 2).count(), 0);
            assert_eq!(squares(6, 5, threads, 2).count(), 0);
        }
    }

    #[test]
    fn errors_and_panics_come_at_their_step_and_the_rest_goes_on() {
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
    fn no_more_than_depth_items_are_made_ahead() {
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

    #[test]
    fn without_threads_nothing_is_made_before_it_is_asked_for() {
        let made = Arc::new(AtomicU64::new(0));
        let counter = Arc::clone(&made);
        let make = move |step| {
            counter.fetch_add(1, Ordering::SeqCst);
            Ok::<_, Failure>(step)
        };
        let mut items = Prefetcher::new(make, 0, 9, 0, 5);
        assert_eq!(made.load(Ordering::SeqCst), 0);
        items.next();
        assert_eq!(made.load(Ordering::SeqCst), 1);
    }
}
