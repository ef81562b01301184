//! Runs candidates: compiles, compares with f64, times and prints.

use std::cell::OnceCell;
use std::fmt::Write;
use std::time::{Duration, Instant};

use clift_cube::Buffer;
use cubecl::prelude::Client;

use crate::cases::Case;

/// Time of launches before the samples: a GPU raises its clocks only under load.
const WARM_UP: Duration = Duration::from_millis(300);
/// Time of the launches between two waits, which take some 50 us.
const SAMPLE: Duration = Duration::from_millis(4);
/// Time of all samples.
const TOTAL: Duration = Duration::from_millis(100);
const MAX_SAMPLES: usize = 15;

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

    /// Runs a kernel with every tile and prints the results; `make` returns its computation, in a small size (true) for the
    /// comparison with f64 or in full, which takes `flops` operations. Ends the process if a candidate fails.
    pub fn run<T: Copy>(
        &mut self,
        kernel: &str,
        case: &str,
        flops: f64,
        tiles: &[(String, T)],
        make: impl Fn(T, bool) -> Case,
    ) {
        let inputs = OnceCell::new();
        for (name, tile) in tiles {
            let index = self.index;
            self.index += 1;
            if index < self.first {
                continue;
            }
            let mut line =
                format!("{{\"index\":{index},\"kernel\":\"{kernel}\",\"case\":\"{case}\",\"tile\":\"{name}\"");
            println!("{line},\"state\":\"starts\"}}");
            let [small, full] = [true, false].map(|is_small| make(*tile, is_small));
            let inputs = inputs.get_or_init(|| full.upload(self.client));
            let measured = self.measure(flops, &small, || (full.run)(self.client, inputs));
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
    }

    fn measure(&self, flops: f64, small: &Case, launch: impl Fn() -> Vec<Buffer>) -> Result<String, String> {
        let inputs = small.upload(self.client);
        self.wait(&inputs)?;
        let start = Instant::now();
        let results = (small.run)(self.client, &inputs);
        self.wait(&results)?;
        let first = start.elapsed();
        let error = small.errors(self.client, &results)?.into_iter().fold(0.0, f64::max);
        drop((inputs, results));
        self.wait(&launch())?;

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
        let rate = 1e-12 * flops / median;
        // JSON cannot represent infinity.
        let error = if error.is_finite() { format!("{error:.2e}") } else { "null".into() };
        let (first, median) = (1e3 * first.as_secs_f64(), 1e3 * median);
        Ok(format!(
            ",\"first_ms\":{first:.1},\"ms\":{median:.4},\"rate\":{rate:.3},\"unit\":\"TFLOP/s\",\"error\":{error}"
        ))
    }

    /// Waits for the device and returns its error: a refused launch fails only here.
    fn wait(&self, results: &[Buffer]) -> Result<(), String> {
        let handles = results.iter().map(|buffer| &buffer.handle);
        cubecl::future::block_on(self.client.sync_buffers(handles)).map_err(|error| error.to_string())
    }
}
