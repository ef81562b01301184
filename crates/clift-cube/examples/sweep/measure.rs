//! Runs candidates: compiles, compares with f64, times and prints.

use std::fmt::Write;
use std::time::{Duration, Instant};

use clift_cube::Buffer;
use cubecl::prelude::Client;

/// Time of launches before the samples: a GPU raises its clocks only under load.
const WARM_UP: Duration = Duration::from_millis(300);
/// Time of the launches between two waits, which take some 50 us.
const SAMPLE: Duration = Duration::from_millis(4);
/// Time of all samples.
const TOTAL: Duration = Duration::from_millis(100);
const MAX_SAMPLES: usize = 15;

/// Work of a candidate, of which its rate is computed.
#[derive(Clone, Copy)]
pub enum Work {
    /// Floating-point operations.
    Flops(f64),
    /// Values in f32 of the inputs and results.
    Values(f64),
}

/// Sampled values of a result, computed and expected.
pub type Pairs = Vec<(f64, f64)>;

/// Candidates in their order; those before `first` are not run.
pub struct Sweep<'a> {
    pub client: &'a Client,
    first: usize,
    index: usize,
}

impl<'a> Sweep<'a> {
    pub fn new(client: &'a Client, first: usize) -> Self {
        Self { client, first, index: 0 }
    }

    /// Runs a candidate and prints its results; `check` returns samples of every result. Ends the process if it fails.
    pub fn run(
        &mut self,
        kernel: &str,
        case: &str,
        tile: &str,
        work: Work,
        launch: impl Fn() -> Vec<Buffer>,
        check: impl Fn(&[Buffer]) -> Result<Vec<Pairs>, String>,
    ) {
        let index = self.index;
        self.index += 1;
        if index < self.first {
            return;
        }
        let mut line = format!("{{\"index\":{index},\"kernel\":\"{kernel}\",\"case\":\"{case}\",\"tile\":\"{tile}\"");
        println!("{line},\"state\":\"starts\"}}");
        let measured = self.measure(work, launch, check);
        match &measured {
            Ok(fields) => line.push_str(fields),
            Err(error) => {
                let readable = |c: char| if c.is_control() || "\"\\".contains(c) { ' ' } else { c };
                let error: String = error.chars().map(readable).take(600).collect();
                write!(line, ",\"failed\":\"{error}\"").expect("a string grows");
            }
        }
        println!("{line}}}");
        if measured.is_err() {
            std::process::exit(3);
        }
    }

    fn measure(
        &self,
        work: Work,
        launch: impl Fn() -> Vec<Buffer>,
        check: impl Fn(&[Buffer]) -> Result<Vec<Pairs>, String>,
    ) -> Result<String, String> {
        self.wait(&[])?;
        let start = Instant::now();
        let results = launch();
        self.wait(&results)?;
        let first = start.elapsed();
        let error = check(&results)?.iter().map(error).fold(0.0, f64::max);
        drop(results);

        let sample = |count: u32| -> Result<Duration, String> {
            let start = Instant::now();
            let results = (0..count).map(|_| launch()).last().unwrap_or_default();
            self.wait(&results)?;
            Ok(start.elapsed() / count)
        };
        let once = sample(1)?;
        let count = (SAMPLE.as_secs_f64() / once.as_secs_f64()).clamp(1.0, 64.0) as u32;
        let start = Instant::now();
        while start.elapsed() < WARM_UP {
            sample(count)?;
        }
        let count = (SAMPLE.as_secs_f64() / sample(count)?.as_secs_f64()).clamp(1.0, 64.0) as u32;
        let (start, mut samples) = (Instant::now(), Vec::new());
        while samples.len() < 3 || (start.elapsed() < TOTAL && samples.len() < MAX_SAMPLES) {
            samples.push(sample(count)?.as_secs_f64());
        }
        samples.sort_by(f64::total_cmp);
        let median = samples[samples.len() / 2];
        let (rate, unit) = match work {
            Work::Flops(flops) => (1e-12 * flops / median, "TFLOP/s"),
            Work::Values(values) => (4e-9 * values / median, "GB/s"),
        };
        // JSON cannot represent infinity.
        let error = if error.is_finite() { format!("{error:.2e}") } else { "null".into() };
        let (first, median) = (1e3 * first.as_secs_f64(), 1e3 * median);
        Ok(format!(
            ",\"first_ms\":{first:.1},\"ms\":{median:.4},\"rate\":{rate:.3},\"unit\":\"{unit}\",\"error\":{error}"
        ))
    }

    /// Waits for the device and returns its error: a refused launch fails only here.
    fn wait(&self, results: &[Buffer]) -> Result<(), String> {
        let handles = results.iter().map(|buffer| &buffer.handle);
        cubecl::future::block_on(self.client.sync_buffers(handles)).map_err(|error| error.to_string())
    }
}

/// Returns the largest difference over the largest expected value, infinite where a value is not finite.
fn error(pairs: &Pairs) -> f64 {
    let size = pairs.iter().map(|(_, expected)| expected.abs()).fold(f64::MIN_POSITIVE, f64::max);
    let difference = |&(computed, expected): &(f64, f64)| {
        if computed.is_finite() { (computed - expected).abs() / size } else { f64::INFINITY }
    };
    pairs.iter().map(difference).fold(0.0, f64::max)
}
