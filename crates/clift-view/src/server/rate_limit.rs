//! Messages per second of a socket.

use std::time::{Duration, Instant};

/// Messages per second; a page sends at most one camera per screen refresh and one acknowledgement per frame.
const PER_SECOND: f64 = 1000.0;
/// Messages at once after a pause.
const BURST: f64 = 1000.0;

/// A bucket of allowed messages that fills with time.
#[derive(Debug)]
pub struct RateLimit {
    allowed: f64,
    filled: Instant,
}

impl RateLimit {
    pub fn new(now: Instant) -> Self {
        Self { allowed: BURST, filled: now }
    }

    /// Counts a message and returns how long to wait before the next one is read.
    pub fn wait(&mut self, now: Instant) -> Duration {
        let passed_s = now.saturating_duration_since(self.filled).as_secs_f64();
        self.allowed = (self.allowed + PER_SECOND * passed_s).min(BURST) - 1.0;
        self.filled = now;
        Duration::from_secs_f64((-self.allowed).max(0.0) / PER_SECOND)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bursts_pass_and_floods_wait() {
        let start = Instant::now();
        let mut limit = RateLimit::new(start);
        assert!((0..1000).all(|_| limit.wait(start).is_zero()));
        assert_eq!(limit.wait(start), Duration::from_millis(1));
        assert_eq!(limit.wait(start), Duration::from_millis(2));
        assert!(limit.wait(start + Duration::from_millis(4)).is_zero());
        let mut limit = RateLimit::new(start);
        assert!((0..5000).all(|i| limit.wait(start + Duration::from_millis(2 * i)).is_zero()), "500 per second");
    }
}
