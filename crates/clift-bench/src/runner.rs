//! `clift bench`: time of the parts of the method on a device, and the error of each result against f64.
//!
//! Inputs come from the config's seed; no data is read. Time and error are measured together, because a wrong kernel can be
//! fast.

use std::sync::atomic::{AtomicBool, Ordering};

use clift_core::{median, p95};
use clift_eval::{peak_bytes, start_peak};
use clift_model::{DeviceName, Precision};
use clift_train::{Config, Stage, TrainError};
use serde::Serialize;

use crate::cases::case::BenchCase;
use crate::cases::clustering::KMeansCase;
use crate::cases::context::{BenchContext, BenchOptions};
use crate::cases::forward;
use crate::cases::step::StepCase;
use crate::cases::task::BenchTask;

/// Results of a benchmark.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct BenchReport {
    /// Device of the tensors.
    pub device: DeviceName,
    /// Operands of matrix products.
    pub precision: Precision,
    /// Threads of the CPU devices.
    pub threads: usize,
    /// One row per case.
    pub rows: Vec<BenchRow>,
}

/// Measurements of one case.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct BenchRow {
    /// The case.
    pub case: BenchCase,
    /// Median of the samples.
    pub median_s: f64,
    /// 95th percentile of the samples, nearest rank.
    pub p95_s: f64,
    /// Peak memory of the process during the samples; `None` on a GPU, and on systems without this counter.
    pub peak_bytes: Option<u64>,
    /// Largest difference from f64 over the largest value; `None` without the f64 check. For an update: the largest error
    /// of the loss and of each parameter's gradient, with at most
    /// [`MAX_CHECKED_TOKENS`](crate::MAX_CHECKED_TOKENS) tokens. For K-means: the relative difference of the inertia, since
    /// the f64 clustering may differ.
    pub max_rel_error: Option<f64>,
    /// Seconds of every timed repetition; per view for `render_8_views`.
    pub samples_s: Vec<f64>,
}

/// Times the cases of `options` on the device of `config`; of a network without clusters those that it has. Passes finished
/// rows to `report`.
pub fn run_bench(
    config: &Config,
    options: &BenchOptions,
    stop: &AtomicBool,
    report: &mut dyn FnMut(&BenchRow),
) -> Result<BenchReport, TrainError> {
    let context = BenchContext::new(config, options)?;
    let mut rows = Vec::new();
    for case in context.cases() {
        let row = measure(case, &context, options, stop)?;
        report(&row);
        rows.push(row);
    }
    let (device, precision, threads) = (config.device, config.precision, rayon::current_num_threads());
    Ok(BenchReport { device, precision, threads, rows })
}

/// Makes networks and inputs of a case, so that only its computation is left to be timed.
pub(crate) fn prepare(case: BenchCase, context: &BenchContext) -> Result<Box<dyn BenchTask>, TrainError> {
    Ok(match case {
        BenchCase::Encode => Box::new(forward::encode(context)?),
        BenchCase::Kmeans => Box::new(KMeansCase::new(context)?),
        BenchCase::Condense => Box::new(forward::condense(context)?),
        BenchCase::ClusterAttention => Box::new(forward::attention_in_clusters(context)?),
        BenchCase::Render => Box::new(forward::render(context, 1)?),
        BenchCase::Render8Views => Box::new(forward::render(context, 8)?),
        BenchCase::Stage1Step => Box::new(StepCase::new(context, Stage::Stage1)?),
        BenchCase::Stage2Step => Box::new(StepCase::new(context, Stage::Stage2)?),
    })
}

fn measure(
    case: BenchCase,
    context: &BenchContext,
    options: &BenchOptions,
    stop: &AtomicBool,
) -> Result<BenchRow, TrainError> {
    let _precision = context.config.precision.scope();
    let go_on = || {
        let abandoned = || TrainError::Abandoned { task: format!("timing `{case}`") };
        if stop.load(Ordering::Relaxed) { Err(abandoned()) } else { Ok(()) }
    };
    let mut task = prepare(case, context)?;
    go_on()?;
    for _ in 0..options.warmup {
        context.time(task.as_mut())?;
        go_on()?;
    }
    let has_peak = context.is_cpu && start_peak().is_some();
    let mut samples_s = Vec::with_capacity(options.repeats);
    for _ in 0..options.repeats {
        samples_s.push(context.time(task.as_mut())? / task.num_views() as f64);
        go_on()?;
    }
    let peak_bytes = if has_peak { peak_bytes() } else { None };
    let max_rel_error = options.error.then(|| task.error(&context.reference()?)).transpose()?;
    go_on()?;
    let (median_s, p95_s) = (median(&samples_s), p95(&samples_s));
    Ok(BenchRow { case, median_s, p95_s, peak_bytes, max_rel_error, samples_s })
}

#[cfg(test)]
mod tests {
    use clift_data::ViewSampler;
    use clift_model::{InstructionSet, ModelConfig, TokenCount};

    use super::*;

    /// Sixteen tokens of width 16, four views of 16 x 16.
    fn config(device: DeviceName) -> Config {
        let mut config = Config { run_dir: "run".into(), device, model: ModelConfig::small(), ..Config::default() };
        (config.data.width, config.data.height) = (16, 16);
        config.data.views = ViewSampler { num_targets: 1, ..ViewSampler::default() };
        (config.stage1.batch_size, config.stage2.batch_size) = (2, 2);
        config
    }

    fn options(cases: &[BenchCase]) -> BenchOptions {
        let stored_tokens = TokenCount::Share(0.25);
        BenchOptions { cases: cases.into(), repeats: 2, warmup: 0, error: true, stored_tokens }
    }

    #[test]
    fn every_row_runs_close_to_f64_on_cpu_devices() {
        // Blocks of f32 as in the tests of the model: outputs to 1e-5, gradients to 5e-5. Operands of 11 bits, and of 8.
        let forward = &[BenchCase::Encode, BenchCase::Render][..];
        for (device, precision, cases, bound) in [
            (DeviceName::Flex, Precision::F32, BenchCase::ALL, 1e-4),
            (DeviceName::Ndarray, Precision::F32, BenchCase::ALL, 1e-4),
            (DeviceName::Flex, Precision::F16, forward, 5e-2),
            (DeviceName::Flex, Precision::Bf16, forward, 2e-1),
        ] {
            if precision == Precision::Bf16 && !InstructionSet::detected().has_bf16() {
                println!("no bf16: {} does not have the instructions", InstructionSet::detected().name());
                continue;
            }
            let mut finished = Vec::new();
            let mut note = |row: &BenchRow| finished.push(row.case);
            let options = options(cases);
            let config = Config { precision, ..config(device) };
            let report = run_bench(&config, &options, &AtomicBool::new(false), &mut note).expect("runs");
            assert_eq!(report.rows.iter().map(|row| row.case).collect::<Vec<_>>(), cases);
            for row in &report.rows {
                let close = row.max_rel_error.map(|error| error < bound);
                assert_eq!(close, Some(true), "{device}, {precision}: {row:?}");
                assert_eq!(row.samples_s.len(), 2);
                assert!(row.median_s > 0.0 && row.p95_s >= row.median_s, "{row:?}");
                assert!(row.peak_bytes.is_none_or(|bytes| bytes > 1 << 20), "{row:?}");
                assert!(row.samples_s.iter().all(|sample| (0.0..=row.p95_s).contains(sample)));
            }
            // An f32 result that was compared with itself would be exact.
            let exact = |row: &&BenchRow| row.case != BenchCase::Kmeans && row.max_rel_error == Some(0.0);
            assert_eq!(report.rows.iter().find(exact), None);
            assert_eq!(finished, cases);
        }
    }

    #[test]
    fn checked_update_keeps_its_shape_with_fewer_tokens() {
        let mut config = config(DeviceName::Flex);
        (config.data.width, config.data.height) = (448, 256);
        config.stage1.batch_size = 64;
        let options = BenchOptions { stored_tokens: TokenCount::Count(448), ..options(&[]) };
        let context = BenchContext::new(&config, &options).expect("valid");
        assert_eq!(context.num_tokens().expect("whole patches"), 7168);
        let reduced = context.reduced().expect("valid");
        // 28 x 16 patches are halved once to 14 x 8.
        assert_eq!((reduced.config.data.width, reduced.config.data.height), (112, 64));
        assert_eq!((reduced.num_tokens().unwrap(), reduced.num_storage_tokens().unwrap()), (448, 28));
        assert_eq!(reduced.config.stage1.batch_size, 2);
    }
}
