//! Messages per second of a socket.

use std::time::Instant;

/// Messages per second; a page sends at most one camera per screen refresh and one acknowledgement per frame.
const PER_SECOND: f64 = 500.0;
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

    /// Counts a message; `false` for one too many.
    pub fn accepts(&mut self, now: Instant) -> bool {
        let passed_s = now.saturating_duration_since(self.filled).as_secs_f64();
        self.allowed = (self.allowed + PER_SECOND * passed_s).min(BURST) - 1.0;
        self.filled = now;
        self.allowed >= 0.0
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn bursts_pass_and_floods_do_not() {
        let start = Instant::now();
        let mut limit = RateLimit::new(start);
        assert!((0..1000).all(|_| limit.accepts(start)));
        assert!(!limit.accepts(start));
        let mut limit = RateLimit::new(start);
        assert!((0..3000).all(|i| limit.accepts(start + Duration::from_millis(4 * i))), "250 per second");
        let mut limit = RateLimit::new(start);
        assert!(!(0..3000).all(|i| limit.accepts(start + Duration::from_millis(i))), "1000 per second");
    }
}
