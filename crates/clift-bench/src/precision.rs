//! `clift bench half`: f16 products beside f32 ones, speed and what they cost in one row.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use burn::module::{Module, ModuleVisitor, Param};
use burn::optim::GradientsParams;
use burn::tensor::Tensor;
use clift_data::median;
use clift_model::{DeviceName, Precision};
use clift_train::{Config, DeviceBatch, Stage, TrainError, freeze, psnr_of};
use serde::Serialize;

use crate::cases::case::BenchCase;
use crate::cases::context::BenchContext;
use crate::cases::forward::{Encode, Render};
use crate::cases::options::BenchOptions;
use crate::cases::reference::values;
use crate::cases::step::{gradients, loss_factor, micro_batch};
use crate::cases::task::{BenchTask, Forward};

/// The works that are compared.
pub const WORKS: [BenchCase; 4] = [BenchCase::Encode, BenchCase::Render, BenchCase::Stage1Step, BenchCase::Stage2Step];

/// What was measured.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PrecisionReport {
    /// Where tensors were.
    pub device: DeviceName,
    /// One per work.
    pub rows: Vec<PrecisionRow>,
}

/// One work in both precisions.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PrecisionRow {
    /// Which work.
    pub work: BenchCase,
    /// Median seconds with f32 products.
    pub f32_s: f64,
    /// Median seconds with f16 products, in turn with the others.
    pub f16_s: f64,
    /// The second over the first.
    pub ratio: f64,
    /// Norm of the difference over the norm of the f32 result: of tokens, of pictures, of an update's whole gradient.
    pub error: f64,
    /// Of an update: the loss in f32 and in f16. PSNR is `-10 log10` of it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub loss: Option<[f64; 2]>,
    /// Of pictures: PSNR of the f16 ones against the f32 ones, in dB.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub psnr_to_f32: Option<f64>,
}

impl PrecisionRow {
    /// PSNR of an update's pictures against its targets, in f32 and in f16.
    pub fn psnr(&self) -> Option<[f64; 2]> {
        self.loss.map(|loss| loss.map(psnr_of))
    }
}

/// Times the works of `options` in both precisions, in turn, on the device of `config`, and compares their results.
///
/// # Errors
/// [`TrainError::BadConfig`] for sizes that cannot be, [`clift_model::ModelError::BadConfig`] on a device without f16,
/// [`TrainError::Abandoned`] after `stop` was set.
pub fn compare(config: &Config, options: &BenchOptions, stop: &AtomicBool) -> Result<PrecisionReport, TrainError> {
    if let Some(other) = options.work.iter().find(|work| !WORKS.contains(work)) {
        let fix = format!("write some of {}", WORKS.map(BenchCase::name).join(", "));
        return Err(TrainError::BadConfig { key: "--work".into(), value: other.name().into(), fix });
    }
    let [single, half] = [Precision::F32, Precision::F16]
        .map(|precision| BenchContext::new(&Config { precision, ..config.clone() }, options));
    let contexts = [single?, half?];
    let mut rows = Vec::new();
    for work in WORKS.into_iter().filter(|work| options.work.contains(work)) {
        let [f32_s, f16_s] = times(work, &contexts, options, stop)?;
        let Compared { error, loss, psnr_to_f32 } = compared(work, &contexts[0])?;
        rows.push(PrecisionRow { work, f32_s, f16_s, ratio: f16_s / f32_s, error, loss, psnr_to_f32 });
    }
    Ok(PrecisionReport { device: config.device, rows })
}

fn times(
    work: BenchCase,
    contexts: &[BenchContext; 2],
    options: &BenchOptions,
    stop: &AtomicBool,
) -> Result<[f64; 2], TrainError> {
    let scoped = |context: &BenchContext| context.config.precision.scope();
    let mut tasks: Vec<Box<dyn BenchTask>> = Vec::new();
    for context in contexts {
        let _scope = scoped(context);
        tasks.push(work.prepare(context)?);
    }
    let mut samples = [Vec::new(), Vec::new()];
    for repeat in 0..options.warmup + options.repeats {
        for ((task, context), samples) in tasks.iter_mut().zip(contexts).zip(&mut samples) {
            if stop.load(Ordering::Relaxed) {
                return Err(TrainError::Abandoned { work: format!("`{}`", work.name()) });
            }
            let _scope = scoped(context);
            context.sync()?;
            let started = Instant::now();
            task.run()?;
            context.sync()?;
            if repeat >= options.warmup {
                samples.push(started.elapsed().as_secs_f64());
            }
        }
    }
    Ok(samples.map(|samples| median(&samples)))
}

struct Compared {
    error: f64,
    loss: Option<[f64; 2]>,
    psnr_to_f32: Option<f64>,
}

fn compared(work: BenchCase, context: &BenchContext) -> Result<Compared, TrainError> {
    let both = |forward: &dyn Fn() -> Tensor<1>| {
        [Precision::F32, Precision::F16].map(|precision| {
            let _scope = precision.scope();
            values(forward())
        })
    };
    let stage = match work {
        BenchCase::Encode => {
            let encode = Encode::new(context)?;
            let [single, half] = both(&|| encode.forward());
            return Ok(Compared { error: distance(&half, &single), loss: None, psnr_to_f32: None });
        }
        BenchCase::Render => {
            let render = Render::new(context, 1)?;
            let [single, half] = both(&|| render.forward());
            let squares = half.iter().zip(&single).map(|(a, b)| (a - b).powi(2));
            let mse = squares.sum::<f64>() / single.len() as f64;
            return Ok(Compared { error: distance(&half, &single), loss: None, psnr_to_f32: Some(psnr_of(mse)) });
        }
        BenchCase::Stage2Step => Stage::Stage2,
        _ => Stage::Stage1,
    };
    let model = freeze(stage, context.model());
    let batch = micro_batch(context, stage)?;
    let mut results = Vec::new();
    for precision in [Precision::F32, Precision::F16] {
        let _scope = precision.scope();
        let shown = DeviceBatch::upload(&batch, &context.device.clone().autodiff())?;
        let (loss, grads) = gradients(&model, &batch, shown)?;
        results.push((loss, flat(&model, &grads, loss_factor())));
    }
    let [(single_loss, single), (half_loss, half)] = &results[..] else { unreachable!("two precisions") };
    Ok(Compared { error: distance(half, single), loss: Some([*single_loss, *half_loss]), psnr_to_f32: None })
}

/// `|a - b| / |b|`, NaN where a value is none.
fn distance(a: &[f64], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len(), "the same result twice");
    let norm = |squares: f64| squares.sqrt();
    let difference = norm(a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum());
    if difference == 0.0 { 0.0 } else { difference / norm(b.iter().map(|b| b.powi(2)).sum()) }
}

/// The gradient of all parameters, one after the other, over the factor of its loss.
fn flat<M: Module>(model: &M, grads: &GradientsParams, factor: f64) -> Vec<f64> {
    struct Collect<'a>(&'a GradientsParams, Vec<f64>);
    impl ModuleVisitor for Collect<'_> {
        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            if let Some(grad) = self.0.get::<D>(param.id) {
                self.1.extend(values(grad));
            }
        }
    }
    let mut collect = Collect(grads, Vec::new());
    model.visit(&mut collect);
    collect.1.iter().map(|value| value / factor).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::runner::tests::{config, options};

    #[test]
    fn every_row_is_near_f32_and_not_equal_to_it() {
        let report = compare(&config(DeviceName::Flex), &options(&WORKS), &AtomicBool::new(false)).expect("runs");
        assert_eq!(report.rows.iter().map(|row| row.work).collect::<Vec<_>>(), WORKS);
        for row in &report.rows {
            // Operands of 11 bits, through two blocks and back.
            assert!(row.error > 1e-6 && row.error < 1e-2, "{row:?}");
            let is_step = matches!(row.work, BenchCase::Stage1Step | BenchCase::Stage2Step);
            assert_eq!((row.loss.is_some(), row.psnr_to_f32.is_some()), (is_step, row.work == BenchCase::Render));
            if let Some([single, half]) = row.psnr() {
                assert!((single - half).abs() < 0.01, "{row:?}");
            }
            assert!(row.psnr_to_f32.is_none_or(|psnr| psnr > 50.0), "{row:?}");
        }
        let refused = compare(&config(DeviceName::Ndarray), &options(&WORKS), &AtomicBool::new(false)).unwrap_err();
        assert!(refused.to_string().contains("no f16"), "{refused}");
    }

    #[test]
    fn the_distance_is_that_of_norms() {
        assert_eq!(distance(&[3.0, 4.0], &[0.0, 4.0]), 0.75);
        assert_eq!(distance(&[0.0], &[0.0]), 0.0);
        assert!(distance(&[f64::NAN], &[1.0]).is_nan());
    }
}
