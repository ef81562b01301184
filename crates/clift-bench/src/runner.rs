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
use crate::cases::coding::CodingCase;
use crate::cases::context::{BenchContext, BenchOptions};
use crate::cases::flops::flops;
use crate::cases::forward;
use crate::cases::selection::SelectionCase;
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
    /// [Peak](clift_model::peak_flops) of the device in `precision`, measured between the cases.
    pub peak_flops: Option<f64>,
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
    /// Floating-point operations of layers and attention in a repetition: two per multiply-accumulate, a backward counts
    /// as two forwards; `None` for cases of other work.
    pub flops: Option<f64>,
    /// Seconds of every timed repetition; per view for `render_8_views`.
    pub samples_s: Vec<f64>,
    /// Sum of squared distances to the cluster means, for K-means.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub inertia: Option<f64>,
}

/// Progress of a benchmark.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum BenchEvent<'a> {
    /// Repetitions that are done; the comparison with f64 counts as one.
    Progress {
        /// Repetitions so far.
        done: usize,
        /// Repetitions in all.
        total: usize,
    },
    /// A row is complete.
    Finished(&'a BenchRow),
}

/// Times the cases of `options` on the device of `config`; of a network without clusters those that it has.
///
/// # Errors
/// [`TrainError::BadConfig`] for impossible sizes, [`TrainError::Abandoned`] between two repetitions after `stop` was set, and
/// those of the device or of the file of features.
pub fn run_bench(
    config: &Config,
    options: &BenchOptions,
    stop: &AtomicBool,
    report: &mut dyn FnMut(BenchEvent),
) -> Result<BenchReport, TrainError> {
    let context = BenchContext::new(config, options)?;
    let is_measured = |case: &BenchCase| {
        options.cases.contains(case) && (config.model.architecture.supports_clusters() || !case.needs_clusters())
    };
    let cases: Vec<BenchCase> = BenchCase::ALL.iter().copied().filter(is_measured).collect();
    let total = cases.len() * (options.warmup + options.repeats + usize::from(options.error));
    let mut done = 0;
    let device = config.device.open()?;
    let peak = || clift_model::peak_flops(&device, config.precision);
    let mut peak_flops = peak();
    let mut rows = Vec::with_capacity(cases.len());
    for case in cases {
        let mut advance = |count| {
            done += count;
            report(BenchEvent::Progress { done, total });
            if stop.load(Ordering::Relaxed) {
                Err(TrainError::Abandoned { task: format!("timing `{case}`") })
            } else {
                Ok(())
            }
        };
        let row = measure(case, &context, options, &mut advance)?;
        report(BenchEvent::Finished(&row));
        rows.push(row);
        peak_flops = peak_flops.zip(peak()).map(|(former, now)| former.max(now));
    }
    let (device, precision, threads) = (config.device, config.precision, rayon::current_num_threads());
    Ok(BenchReport { device, precision, threads, peak_flops, rows })
}

/// Makes networks and inputs of a case, so that only its computation is left to be timed.
pub(crate) fn prepare(case: BenchCase, context: &BenchContext) -> Result<Box<dyn BenchTask>, TrainError> {
    Ok(match case {
        BenchCase::Encode => Box::new(forward::encode(context)?),
        BenchCase::Kmeans => Box::new(KMeansCase::new(context)?),
        BenchCase::Condense => Box::new(forward::condense(context)?),
        BenchCase::ClusterAttention => Box::new(forward::attention_in_clusters(context)?),
        BenchCase::Select => Box::new(SelectionCase::new(context)?),
        BenchCase::CodeTokens => Box::new(CodingCase::new(context, false)?),
        BenchCase::DecodeTokens => Box::new(CodingCase::new(context, true)?),
        BenchCase::Render => Box::new(forward::render(context, 1)?),
        BenchCase::Render8Views => Box::new(forward::render(context, 8)?),
        BenchCase::Stage1Step => Box::new(StepCase::new(context, Stage::Stage1)?),
        BenchCase::Stage1StepTiny => Box::new(StepCase::new(&context.tiny(), Stage::Stage1)?),
        BenchCase::Stage2Step => Box::new(StepCase::new(context, Stage::Stage2)?),
    })
}

fn measure(
    case: BenchCase,
    context: &BenchContext,
    options: &BenchOptions,
    advance: &mut dyn FnMut(usize) -> Result<(), TrainError>,
) -> Result<BenchRow, TrainError> {
    let _precision = context.config.precision.scope();
    let mut task = prepare(case, context)?;
    advance(0)?;
    for _ in 0..options.warmup {
        context.time(task.as_mut())?;
        advance(1)?;
    }
    let has_peak = context.is_cpu && start_peak().is_some();
    let mut samples_s = Vec::with_capacity(options.repeats);
    for _ in 0..options.repeats {
        samples_s.push(context.time(task.as_mut())? / task.num_views() as f64);
        advance(1)?;
    }
    let peak_bytes = if has_peak { peak_bytes() } else { None };
    let inertia = task.inertia();
    let max_rel_error = if options.error {
        let error = task.error(&context.reference()?)?;
        advance(1)?;
        error
    } else {
        None
    };
    let (median_s, p95_s) = (median(&samples_s), p95(&samples_s));
    let flops = flops(case, context)?;
    Ok(BenchRow { case, median_s, p95_s, peak_bytes, max_rel_error, flops, samples_s, inertia })
}

#[cfg(test)]
pub(crate) mod tests {
    use clift_data::ViewSampler;
    use clift_model::{ModelConfig, TokenCount};

    use super::*;

    /// Sixteen tokens of width 16, four views of 16 x 16.
    pub fn config(device: DeviceName) -> Config {
        let model = ModelConfig {
            dim: 16,
            num_heads: 2,
            feed_forward_dim: 24,
            num_encoder_blocks: 1,
            num_renderer_blocks: 1,
            ..ModelConfig::default()
        };
        let mut config = Config { run_dir: "run".into(), device, model, ..Config::default() };
        (config.data.width, config.data.height) = (16, 16);
        config.data.views = ViewSampler { num_targets: 1, ..ViewSampler::default() };
        (config.stage1.batch_size, config.stage2.batch_size) = (2, 2);
        config
    }

    pub fn options(cases: &[BenchCase]) -> BenchOptions {
        let stored_tokens = TokenCount::Share(0.25);
        BenchOptions { repeats: 2, error: true, stored_tokens, ..BenchOptions::new(cases.into()) }
    }

    #[test]
    fn every_row_runs_close_to_f64_on_cpu_devices() {
        for device in [DeviceName::Flex, DeviceName::Ndarray] {
            let mut events = Vec::new();
            let mut note = |event: BenchEvent| match event {
                BenchEvent::Progress { done, total } => events.push((done, total)),
                BenchEvent::Finished(_) => {}
            };
            let options = options(BenchCase::ALL);
            let report = run_bench(&config(device), &options, &AtomicBool::new(false), &mut note).expect("runs");
            assert_eq!(report.rows.iter().map(|row| row.case).collect::<Vec<_>>(), BenchCase::ALL);
            for row in &report.rows {
                // Blocks of f32 as in the tests of the model: outputs to 1e-5, gradients to 5e-5.
                let close = row.max_rel_error.map(|error| error < 1e-4);
                let is_on_host =
                    matches!(row.case, BenchCase::Select | BenchCase::CodeTokens | BenchCase::DecodeTokens);
                assert_eq!(close, (!is_on_host).then_some(true), "{device}: {row:?}");
                assert_eq!(row.samples_s.len(), 2);
                assert!(row.median_s > 0.0 && row.p95_s >= row.median_s, "{row:?}");
                assert!(row.peak_bytes.is_none_or(|bytes| bytes > 1 << 20), "{row:?}");
                assert!(row.samples_s.iter().all(|sample| (0.0..=row.p95_s).contains(sample)));
                assert_eq!(row.inertia.is_some(), row.case == BenchCase::Kmeans);
            }
            // An f32 result that was compared with itself would be exact.
            let exact = |row: &&BenchRow| row.case != BenchCase::Kmeans && row.max_rel_error == Some(0.0);
            assert_eq!(report.rows.iter().find(exact), None);
            let total = BenchCase::ALL.len() * 3;
            assert_eq!(events.last(), Some(&(total, total)));
        }
    }

    #[test]
    fn scenes_may_be_absent_but_sizes_must_fit() {
        let mut config = config(DeviceName::Flex);
        config.data.source = clift_data::SourceKind::Chunks;
        let prepared = |config: &Config, stored: &str| {
            let stored_tokens = stored.parse().expect("a count");
            BenchContext::new(config, &BenchOptions { stored_tokens, ..options(&[]) })
                .map(|context| context.num_tokens())
        };
        assert_eq!(prepared(&config, "16").expect("valid").expect("whole patches"), 16);
        let message = prepared(&config, "17").err().map(|error| error.to_string());
        assert_eq!(message.as_deref(), Some("`--stored-tokens` = 17: `17` tokens: a scene has 16 tokens"));
        config.model.num_heads = 3;
        assert!(prepared(&config, "1/4").is_err());
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
        let tiny = context.tiny().reduced().expect("valid");
        assert_eq!((tiny.num_tokens().unwrap(), tiny.config.stage1.batch_size), (256, 4));
    }
}
