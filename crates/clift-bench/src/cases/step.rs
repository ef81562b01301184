//! The rows of whole optimizer updates, made by the [`TrainState`] of training.

use burn::module::{Module, ModuleVisitor, Param};
use burn::optim::GradientsParams;
use burn::tensor::{Device, Tensor};
use clift_model::{Network, Precision};
use clift_train::{
    DeviceBatch, Loss, LossScale, Stage, StageBatch, StageSettings, StepAnomaly, TrainError, TrainState, freeze,
    learning_rate, render_loss, seeded_batch,
};

use crate::cases::context::BenchContext;
use crate::cases::reference::{ToF64, flat_gradient, largest_magnitude, module_in_f64, values};
use crate::cases::task::BenchTask;

pub struct StepCase {
    stage: Stage,
    /// `None` during a step and after one that failed.
    state: Option<TrainState>,
    batch: StageBatch,
    accumulate: usize,
    rate: f64,
    max_grad_norm: f64,
    /// Sizes of the update that is compared with f64.
    reduced: BenchContext,
}

impl StepCase {
    pub fn new(context: &BenchContext, stage: Stage) -> Result<Self, TrainError> {
        let StageSettings { steps, batch_size, accumulate, optimizer, .. } = context.config.stage(stage);
        let precision = context.config.precision;
        let model = freeze(stage, context.model());
        // Without the VGG network of a perceptual term.
        let plain = TrainState::new(model, optimizer, context.device.clone().autodiff());
        let state = TrainState { precision, loss_scale: LossScale::of(precision), ..plain };
        Ok(Self {
            stage,
            state: Some(state),
            batch: stage_batch(context, stage, batch_size)?,
            accumulate,
            rate: learning_rate(optimizer, 1, steps),
            max_grad_norm: optimizer.max_grad_norm,
            reduced: context.reduced()?,
        })
    }
}

/// Makes a batch with all tokens (stage 1) or with stored tokens (stage 2).
fn stage_batch(context: &BenchContext, stage: Stage, batch_size: usize) -> Result<StageBatch, TrainError> {
    let is_stage2 = stage == Stage::Stage2;
    let clusters = if is_stage2 { Some([context.num_tokens()?, context.num_storage_tokens()?]) } else { None };
    seeded_batch(context.shape(), batch_size, clusters, context.config.seed)
}

impl BenchTask for StepCase {
    fn run(&mut self) -> Result<(), TrainError> {
        let state = self.state.take().expect("no step failed before");
        let (mut state, update) = state.step(&self.batch, self.accumulate, self.rate.into(), self.max_grad_norm)?;
        let is_overflow = state.adapt_loss_scale(&update);
        self.state = Some(state);
        // An update that overflows takes as long as another one.
        if update.applied || is_overflow {
            return Ok(());
        }
        let (reason, keys, checkpoint) = (StepAnomaly::NotFinite.to_string(), "seeded".into(), "none".into());
        Err(TrainError::Diverged { count: 1, step: 1, reason, keys, checkpoint })
    }

    fn error(self: Box<Self>, reference: &Device) -> Result<f64, TrainError> {
        let Self { stage, reduced, .. } = *self;
        let batch_size = reduced.config.stage(stage).batch_size;
        let batch = stage_batch(&reduced, stage, batch_size)?;
        let model = freeze(stage, reduced.model());
        update_error(&model, &batch, &reduced.device, reference, 0.0)
    }
}

impl ToF64 for DeviceBatch {
    fn in_f64(&self, reference: &Device) -> Self {
        Self {
            context: self.context.in_f64(reference),
            targets: self.targets.in_f64(reference),
            target_images: self.target_images.in_f64(reference),
            target_weights: None, // of seeded views, which have no masks
        }
    }
}

/// Returns the loss of a batch and the gradient of every parameter, multiplied by [`loss_factor`].
fn gradients(
    model: &Network,
    batch: &StageBatch,
    device_batch: DeviceBatch,
) -> Result<(f64, GradientsParams), TrainError> {
    let loss = render_loss(model, &device_batch, &batch.tokens, &Loss::default(), batch.step)?.total;
    let grads = GradientsParams::from_grads(loss.clone().mul_scalar(loss_factor()).backward(), model);
    Ok((values(loss.inner())[0], grads))
}

/// Returns the loss of a batch and the whole gradient, in the precision of this thread.
pub(crate) fn loss_and_gradient(
    model: &Network,
    batch: &StageBatch,
    device: &Device,
) -> Result<(f64, Vec<f64>), TrainError> {
    let device_batch = DeviceBatch::upload(&batch.clips, &device.clone().autodiff())?;
    let (loss, grads) = gradients(model, batch, device_batch)?;
    Ok((loss, flat_gradient(model, &grads).into_iter().map(|value| value / loss_factor()).collect()))
}

/// Returns the initial loss scale of this thread's precision. The f64 reference uses the same factor, a power of two, which
/// changes no relative error.
fn loss_factor() -> f64 {
    LossScale::of(Precision::current()).map_or(1.0, |scale| scale.factor())
}

/// Returns the largest relative error of an update's loss and gradients against the same update in f64.
///
/// The error of a gradient is relative to the largest entry of its parameter, or to `least_share` of the largest entry of
/// all parameters if that is larger: a gradient that is zero in exact arithmetic, such as that of a query with one key,
/// is rounding noise.
pub(crate) fn update_error(
    model: &Network,
    batch: &StageBatch,
    device: &Device,
    reference: &Device,
    least_share: f64,
) -> Result<f64, TrainError> {
    struct Pairs<'a> {
        result: &'a GradientsParams,
        reference: &'a GradientsParams,
        /// Largest difference and largest entry of every parameter.
        found: Vec<(f64, f64)>,
    }
    impl ModuleVisitor for Pairs<'_> {
        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            match (self.result.get::<D>(param.id), self.reference.get::<D>(param.id)) {
                (Some(result), Some(reference)) => {
                    let (result, reference) = (values(result), values(reference));
                    let difference = largest_magnitude(result.iter().zip(&reference).map(|(a, b)| a - b));
                    self.found.push((difference, largest_magnitude(reference.into_iter())));
                }
                (None, None) => {}
                // Only one side has a gradient.
                (Some(_), None) | (None, Some(_)) => self.found.push((f64::INFINITY, 1.0)),
            }
        }
    }
    let (loss, result) = gradients(model, batch, DeviceBatch::upload(&batch.clips, &device.clone().autodiff())?)?;
    let copy = module_in_f64(model, reference).train();
    let reference = reference.clone().autodiff();
    let device_batch = DeviceBatch::upload(&batch.clips, &reference)?.in_f64(&reference);
    let (expected, reference) = gradients(&copy, batch, device_batch)?;
    let mut pairs = Pairs { result: &result, reference: &reference, found: Vec::new() };
    model.visit(&mut pairs);
    let least = least_share * largest_magnitude(pairs.found.iter().map(|(_, entry)| *entry));
    let loss_error = (loss - expected).abs() / expected.abs().max(f64::MIN_POSITIVE);
    let errors = pairs.found.iter().map(|(difference, entry)| match difference {
        0.0 => 0.0,
        difference => difference / entry.max(least),
    });
    Ok(largest_magnitude(errors.chain([loss_error])))
}
