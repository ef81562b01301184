//! `clift bench`: how long the parts of the method take on a device, and how far each result is from f64.
//!
//! Inputs are drawn from the config's seed; no data is read. Speed stands beside error, so that a kernel that is
//! fast because it is wrong shows.

mod clustering;
mod context;
mod forward;
mod inputs;
mod memory;
mod reference;
mod statistics;
mod step;
mod task;
mod work;

use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use clift_eval::TokenCount;
use clift_model::device::DeviceName;
use serde::Serialize;

use crate::TrainError;
use crate::config::Config;
use context::BenchContext;
pub use work::Work;

/// Most tokens, over all scenes of a batch, of the smaller update whose gradient is compared with f64.
///
/// In f64 a full-size update takes over ten gigabytes and minutes.
pub const MAX_CHECKED_TOKENS: usize = 1024;

/// What is timed, and how.
#[derive(Clone, Debug)]
pub struct BenchOptions {
    /// The rows; [`Work::ALL`] gives them their order.
    pub work: Vec<Work>,
    /// Repetitions that count, at least 1.
    pub repeats: usize,
    /// Repetitions before them that do not.
    pub warmup: usize,
    /// Whether results are compared with f64.
    pub error: bool,
    /// Tokens that are stored.
    pub storage: TokenCount,
    /// A safetensors file whose tensor `features`, `[N, D]` in f32, K-means clusters.
    pub features: Option<PathBuf>,
}

/// What was measured.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Report {
    /// Where tensors were.
    pub device: DeviceName,
    /// Threads of the CPU devices.
    pub threads: usize,
    /// One per work.
    pub rows: Vec<Row>,
}

/// What was measured of one work.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Row {
    /// Which work.
    pub work: Work,
    /// Middle of the samples.
    pub median_s: f64,
    /// 95th percentile of the samples, nearest rank.
    pub p95_s: f64,
    /// Most memory of the whole process during the samples; `None` on a GPU, whose memory the system does not
    /// tell, and where the system has no such count.
    pub peak_bytes: Option<u64>,
    /// Largest difference from f64 over the largest value; `None` where it was not asked for. Of an update: the
    /// largest over its loss and the gradient of each parameter, with at most [`MAX_CHECKED_TOKENS`] tokens. Of
    /// K-means: the relative difference of the inertia, whose f64 clustering may take another turn.
    pub max_rel_error: Option<f64>,
    /// Seconds of every repetition that counts; of `render_8_views` an eighth of them.
    pub samples_s: Vec<f64>,
    /// Of K-means: sum of squared distances to the cluster means.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub inertia: Option<f64>,
}

/// What a benchmark tells while it runs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum BenchEvent<'a> {
    /// So many repetitions of all are done; the comparison with f64 counts as one.
    Progress {
        /// Repetitions so far.
        done: usize,
        /// Repetitions in all.
        total: usize,
    },
    /// A row is complete.
    Finished(&'a Row),
}

/// Times every work that `options` names on the device of `config`.
///
/// # Errors
/// [`TrainError::BadConfig`] for sizes that cannot be, [`TrainError::BenchInterrupted`] between two repetitions
/// after `stop` was set, and what the device or a file of features gives.
pub fn run(
    config: &Config,
    options: &BenchOptions,
    stop: &AtomicBool,
    tell: &mut dyn FnMut(BenchEvent),
) -> Result<Report, TrainError> {
    let context = BenchContext::new(config, options)?;
    let works: Vec<Work> = Work::ALL.into_iter().filter(|work| options.work.contains(work)).collect();
    let total = works.len() * (options.warmup + options.repeats + usize::from(options.error));
    let mut done = 0;
    let mut rows = Vec::with_capacity(works.len());
    for work in works {
        let mut advance = |count| {
            done += count;
            tell(BenchEvent::Progress { done, total });
            // Between repetitions, so that no time is of half a repetition.
            if stop.load(Ordering::Relaxed) { Err(TrainError::BenchInterrupted { work: work.name() }) } else { Ok(()) }
        };
        let row = measure(work, &context, options, &mut advance)?;
        tell(BenchEvent::Finished(&row));
        rows.push(row);
    }
    Ok(Report { device: config.device, threads: rayon::current_num_threads(), rows })
}

fn measure(
    work: Work,
    context: &BenchContext,
    options: &BenchOptions,
    advance: &mut dyn FnMut(usize) -> Result<(), TrainError>,
) -> Result<Row, TrainError> {
    let mut task = work.prepare(context)?;
    context.sync()?;
    advance(0)?;
    for _ in 0..options.warmup {
        task.run()?;
        context.sync()?;
        advance(1)?;
    }
    let has_peak = context.is_cpu && memory::start_peak().is_some();
    let mut samples_s = Vec::with_capacity(options.repeats);
    for _ in 0..options.repeats {
        let started = Instant::now();
        task.run()?;
        // A device that queues its work has only accepted it.
        context.sync()?;
        samples_s.push(started.elapsed().as_secs_f64() / task.num_views() as f64);
        advance(1)?;
    }
    let peak_bytes = if has_peak { memory::peak_bytes() } else { None };
    let inertia = task.inertia();
    let max_rel_error = if options.error {
        let error = task.error(&context.reference()?)?;
        advance(1)?;
        Some(error)
    } else {
        None
    };
    let (median_s, p95_s) = (statistics::median(&samples_s), statistics::p95(&samples_s));
    Ok(Row { work, median_s, p95_s, peak_bytes, max_rel_error, samples_s, inertia })
}
