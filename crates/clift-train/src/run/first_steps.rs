//! Measurements of the first steps: the pace of a stage, and the share of the time that is spent waiting for batches.

use std::time::{Duration, Instant};

use clift_data::{DataConfig, SourceKind};

/// Steps of a stage after which its pace is reported. The first one is not counted: it may compile kernels.
const PACE_STEPS: u32 = 20;
/// Steps that are not counted for the waiting: the first ones start the threads, and fill the cache of photos.
const FIRST_STEPS: u32 = 50;
/// Number of counted steps before the judgement.
const NUM_STEPS: u32 = 50;
/// Share of the time above which reading limits the speed.
const MAX_SHARE: f64 = 0.4;

/// Measures the pace of a new stage.
#[derive(Debug, Default)]
pub(crate) struct Pace {
    num_steps: u32,
    seconds: f64,
}

impl Pace {
    /// Counts the wall time of a step with its batch, in seconds. Returns the mean of steps 2 to 20 once, after step 20.
    pub fn add(&mut self, step_s: f64) -> Option<f64> {
        self.num_steps = self.num_steps.saturating_add(1);
        if self.num_steps > 1 {
            self.seconds += step_s;
        }
        (self.num_steps == PACE_STEPS).then(|| self.seconds / f64::from(PACE_STEPS - 1))
    }
}

/// Measures the first steps of a process and returns a hint if reading limits their speed.
#[derive(Debug)]
pub(crate) struct BatchWait {
    num_steps: u32,
    waited: Duration,
    started: Instant,
}

impl BatchWait {
    /// Starts the measurement.
    pub fn new() -> Self {
        Self { num_steps: 0, waited: Duration::ZERO, started: Instant::now() }
    }

    /// Counts the time that a step waited for its batch. Returns the hint at most once.
    pub fn add(&mut self, waited: Duration, data: &DataConfig) -> Option<String> {
        self.num_steps = self.num_steps.saturating_add(1);
        if self.num_steps <= FIRST_STEPS {
            self.started = Instant::now();
            return None;
        }
        self.waited += waited;
        let is_judged = self.num_steps == FIRST_STEPS + NUM_STEPS;
        is_judged.then(|| hint(self.waited.as_secs_f64() / self.started.elapsed().as_secs_f64(), data)).flatten()
    }
}

/// Returns what makes reading faster, if training waits for more than [`MAX_SHARE`] of the time.
fn hint(share: f64, data: &DataConfig) -> Option<String> {
    if share <= MAX_SHARE {
        return None;
    }
    let mut fixes = vec!["raise data.num_threads".to_owned()];
    if data.source != SourceKind::Synthetic {
        // Training crops the images: their shorter side must stay above the size of training.
        let size = 2 * data.width.max(data.height);
        fixes.push(format!(
            "or reduce large images once with `clift data convert DIR OUT --to chunks --max-size {size} --quality 95`"
        ));
    }
    Some(format!("reading clips takes {:.0} % of the time of training: {}", 100.0 * share, fixes.join(", ")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pace_is_the_mean_without_the_first_step() {
        let mut pace = Pace::default();
        let means: Vec<_> = (0..100).map(|step| pace.add(if step == 0 { 1e3 } else { f64::from(step) })).collect();
        // The mean of 1 to 19.
        assert_eq!(means.iter().flatten().collect::<Vec<_>>(), [&10.0]);
        assert_eq!(means[19], Some(10.0));
    }

    #[test]
    fn hint_names_the_keys_once() {
        let mut wait = BatchWait::new();
        let data = DataConfig { source: SourceKind::Captures, width: 64, ..DataConfig::default() };
        let hints: Vec<String> = (0..200).filter_map(|_| wait.add(Duration::from_secs(1), &data)).collect();
        assert_eq!(hints.len(), 1);
        assert!(hints[0].contains("raise data.num_threads, or reduce") && hints[0].contains("--max-size 512"));
        let mut wait = BatchWait::new();
        assert!((0..200).all(|_| wait.add(Duration::ZERO, &data).is_none()));
        assert!(!hint(0.5, &DataConfig::default()).unwrap().contains("convert"), "rooms have no files");
    }
}
