//! `clift bench precision`: time and error of f16 or bf16 products beside f32 products.

use std::sync::atomic::{AtomicBool, Ordering};

use clift_core::{BadConfig, median};
use clift_model::{DeviceName, Precision, psnr_of_mse};
use clift_train::{Config, Stage, TrainError, freeze};
use serde::Serialize;

use crate::cases::case::BenchCase;
use crate::cases::context::{BenchContext, BenchOptions};
use crate::cases::forward::{encode, render};
use crate::cases::reference::values;
use crate::cases::step::{loss_and_gradient, micro_batch};
use crate::cases::task::BenchTask;
use crate::runner::prepare;

/// The cases that can be compared.
pub const PRECISION_CASES: [BenchCase; 4] =
    [BenchCase::Encode, BenchCase::Render, BenchCase::Stage1Step, BenchCase::Stage2Step];

/// Results of a comparison.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PrecisionReport {
    /// Device of the tensors.
    pub device: DeviceName,
    /// Precision compared with f32.
    pub precision: Precision,
    /// One row per case.
    pub rows: Vec<PrecisionRow>,
}

/// One case in both precisions.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PrecisionRow {
    /// The case.
    pub case: BenchCase,
    /// Median seconds with f32 products.
    pub f32_s: f64,
    /// Median seconds with products in [`PrecisionReport::precision`]; repetitions alternate with those in f32.
    pub reduced_s: f64,
    /// `reduced_s` over `f32_s`.
    pub ratio: f64,
    /// Norm of the difference over the norm of the f32 result: tokens, images or the whole gradient of an update.
    pub error: f64,
    /// Loss of an update in both precisions, f32 first.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub loss: Option<[f64; 2]>,
    /// PSNR of images against those of f32 in dB.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub psnr_to_f32: Option<f64>,
}

impl PrecisionRow {
    /// Returns the PSNR of an update's renderings in dB, in f32 first.
    pub fn psnr(&self) -> Option<[f64; 2]> {
        self.loss.map(|loss| loss.map(psnr_of_mse))
    }
}

/// Times the cases of `options` in f32 and in the precision of `config` (f16 if this is f32), alternating, on its device,
/// and compares their results.
///
/// # Errors
/// [`TrainError::BadConfig`] for impossible sizes, [`clift_model::ModelError::BadConfig`] on a device without the precision,
/// [`TrainError::Abandoned`] after `stop` was set.
pub fn compare_precision(
    config: &Config,
    options: &BenchOptions,
    stop: &AtomicBool,
) -> Result<PrecisionReport, TrainError> {
    if let Some(other) = options.cases.iter().find(|case| !PRECISION_CASES.contains(case)) {
        let fix = format!("write some of {}", PRECISION_CASES.map(BenchCase::name).join(", "));
        return Err(BadConfig::new("--case", other.name(), fix).into());
    }
    let precision = if config.precision == Precision::F32 { Precision::F16 } else { config.precision };
    let context = |precision| BenchContext::new(&Config { precision, ..config.clone() }, options);
    let contexts = [context(Precision::F32)?, context(precision)?];
    let mut rows = Vec::new();
    for case in PRECISION_CASES.into_iter().filter(|case| options.cases.contains(case)) {
        let times = median_times(case, &contexts, options, stop)?;
        rows.push(compare_results(case, &contexts[0], precision, times)?);
    }
    Ok(PrecisionReport { device: config.device, precision, rows })
}

fn median_times(
    case: BenchCase,
    contexts: &[BenchContext; 2],
    options: &BenchOptions,
    stop: &AtomicBool,
) -> Result<[f64; 2], TrainError> {
    let scoped = |context: &BenchContext| context.config.precision.scope();
    let mut tasks: Vec<Box<dyn BenchTask>> = Vec::new();
    for context in contexts {
        let _scope = scoped(context);
        tasks.push(prepare(case, context)?);
    }
    let mut samples = [Vec::new(), Vec::new()];
    for repeat in 0..options.warmup + options.repeats {
        for ((task, context), samples) in tasks.iter_mut().zip(contexts).zip(&mut samples) {
            if stop.load(Ordering::Relaxed) {
                return Err(TrainError::Abandoned { task: format!("timing `{case}`") });
            }
            let _scope = scoped(context);
            let seconds = context.time(task.as_mut())?;
            if repeat >= options.warmup {
                samples.push(seconds);
            }
        }
    }
    Ok(samples.map(|samples| median(&samples)))
}

/// Returns the loss of an update, and what a case computes, in the precision of this thread: tokens, an image or a gradient.
fn result(case: BenchCase, context: &BenchContext) -> Result<(Option<f64>, Vec<f64>), TrainError> {
    let stage = match case {
        BenchCase::Encode => return Ok((None, values(encode(context)?.forward()))),
        BenchCase::Render => return Ok((None, values(render(context, 1)?.forward()))),
        BenchCase::Stage2Step => Stage::Stage2,
        _ => Stage::Stage1,
    };
    let model = freeze(stage, context.model());
    let (loss, gradient) = loss_and_gradient(&model, &micro_batch(context, stage)?, &context.device)?;
    Ok((Some(loss), gradient))
}

fn compare_results(
    case: BenchCase,
    context: &BenchContext,
    precision: Precision,
    [f32_s, reduced_s]: [f64; 2],
) -> Result<PrecisionRow, TrainError> {
    // The renderer reads the same tokens in both.
    context.lift()?;
    let [single, reduced] = [Precision::F32, precision].map(|precision| {
        let _scope = precision.scope();
        result(case, context)
    });
    let ((single_loss, single), (reduced_loss, reduced)) = (single?, reduced?);
    let psnr_to_f32 = (case == BenchCase::Render).then(|| {
        let squares = reduced.iter().zip(&single).map(|(a, b)| (a - b).powi(2));
        psnr_of_mse(squares.sum::<f64>() / single.len() as f64)
    });
    Ok(PrecisionRow {
        case,
        f32_s,
        reduced_s,
        ratio: reduced_s / f32_s,
        error: relative_distance(&reduced, &single),
        loss: single_loss.zip(reduced_loss).map(<[f64; 2]>::from),
        psnr_to_f32,
    })
}

/// Returns `|a - b| / |b|`, NaN if a value is NaN.
fn relative_distance(a: &[f64], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len(), "the same result twice");
    let norm = |squares: f64| squares.sqrt();
    let difference = norm(a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum());
    if difference == 0.0 { 0.0 } else { difference / norm(b.iter().map(|b| b.powi(2)).sum()) }
}

#[cfg(test)]
mod tests {
    use clift_model::InstructionSet;

    use super::*;
    use crate::runner::tests::{config, options};

    /// Compares all cases with f32; errors must be at most `largest`.
    fn check(precision: Precision, largest: f64) {
        let config = Config { precision, ..config(DeviceName::Flex) };
        let report = compare_precision(&config, &options(&PRECISION_CASES), &AtomicBool::new(false)).expect("runs");
        assert_eq!(report.rows.iter().map(|row| row.case).collect::<Vec<_>>(), PRECISION_CASES);
        for row in &report.rows {
            assert!(row.error > 1e-6 && row.error < largest, "{row:?}");
            let is_step = matches!(row.case, BenchCase::Stage1Step | BenchCase::Stage2Step);
            assert_eq!((row.loss.is_some(), row.psnr_to_f32.is_some()), (is_step, row.case == BenchCase::Render));
            if let Some([single, reduced]) = row.psnr() {
                assert!((single - reduced).abs() < 0.01, "{row:?}");
            }
            assert!(row.psnr_to_f32.is_none_or(|psnr| psnr > 50.0), "{row:?}");
        }
    }

    #[test]
    fn every_row_is_close_to_f32_but_not_equal() {
        // Operands of 11 bits, and of 8, through two blocks and back.
        check(Precision::F16, 1e-2);
        if InstructionSet::detected().has_bf16() {
            check(Precision::Bf16, 4e-2);
        } else {
            println!("no bf16: {} does not have the instructions", InstructionSet::detected().name());
        }
        let refused =
            compare_precision(&config(DeviceName::Ndarray), &options(&PRECISION_CASES), &AtomicBool::new(false))
                .unwrap_err();
        assert!(refused.to_string().contains("no f16"), "{refused}");
    }

    #[test]
    fn distance_is_relative_to_norm() {
        assert_eq!(relative_distance(&[3.0, 4.0], &[0.0, 4.0]), 0.75);
        assert_eq!(relative_distance(&[0.0], &[0.0]), 0.0);
        assert!(relative_distance(&[f64::NAN], &[1.0]).is_nan());
    }
}
