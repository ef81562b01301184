//! The rows of whole optimiser updates, by the same [`TrainState`] that trains.

use burn::module::{Module, ModuleVisitor, Param};
use burn::optim::GradientsParams;
use burn::tensor::{Device, Tensor};
use clift_model::{Clift, Precision};
use clift_train::{
    DeviceBatch, Loss, LossScale, Stage, StageBatch, StageSettings, StepAnomaly, TrainError, TrainState, adamw, freeze,
    render_loss, seeded_batch, warm_up_cosine,
};

use crate::cases::context::BenchContext;
use crate::cases::reference::{ToF64, module_in_f64, relative_error, values};
use crate::cases::task::BenchTask;

/// Updates of one batch: forward, loss, backward, clipping, `AdamW`.
pub struct StepTask {
    stage: Stage,
    /// Taken while it makes a step, and gone after one that failed.
    learner: Option<TrainState>,
    batch: StageBatch,
    accumulate: usize,
    rate: f64,
    max_grad_norm: f64,
    /// What the error is taken of.
    reduced: BenchContext,
}

impl StepTask {
    pub fn new(context: &BenchContext, stage: Stage) -> Result<Self, TrainError> {
        let StageSettings { steps, batch_size, accumulate, optimizer, .. } = context.config.stage(stage);
        let learner = TrainState {
            model: freeze(stage, context.model()),
            optimizer: adamw(optimizer),
            device: context.device.clone().autodiff(),
            // The network of a perceptual term is not this project's: the rows are of the model alone.
            loss: Loss::default(),
            activation_checkpointing: context.config.activation_checkpointing,
            loss_scale: LossScale::of(context.config.precision),
        };
        Ok(Self {
            stage,
            learner: Some(learner),
            batch: stage_batch(context, stage, batch_size)?,
            accumulate,
            rate: warm_up_cosine(1, optimizer.learning_rate, optimizer.warm_up_steps, steps),
            max_grad_norm: optimizer.max_grad_norm,
            reduced: context.reduced()?,
        })
    }
}

/// What an update of a stage works off at once.
pub(crate) fn micro_batch(context: &BenchContext, stage: Stage) -> Result<StageBatch, TrainError> {
    let StageSettings { batch_size, accumulate, .. } = context.config.stage(stage);
    stage_batch(context, stage, batch_size.div_ceil(accumulate))
}

/// A batch that keeps every token (stage 1) or the stored ones (stage 2).
fn stage_batch(context: &BenchContext, stage: Stage, batch_size: usize) -> Result<StageBatch, TrainError> {
    let stored = if stage == Stage::Stage2 { Some(context.num_storage_tokens()?) } else { None };
    seeded_batch(context.shape(), batch_size, context.num_tokens()?, stored, context.seed())
}

impl BenchTask for StepTask {
    fn run(&mut self) -> Result<(), TrainError> {
        let learner = self.learner.take().expect("no step failed before");
        let (mut learner, update) = learner.step(&self.batch, self.accumulate, self.rate.into(), self.max_grad_norm)?;
        let is_overflow = learner.adapt_loss_scale(&update);
        self.learner = Some(learner);
        // An update that overflows takes as long as one that does not.
        if update.applied || is_overflow {
            return Ok(());
        }
        let (reason, keys, checkpoint) = (StepAnomaly::NotFinite.to_string(), "made up".into(), "none".into());
        Err(TrainError::Diverged { count: 1, step: 1, reason, keys, checkpoint })
    }

    fn error(self: Box<Self>, reference: &Device) -> Result<Option<f64>, TrainError> {
        let Self { stage, reduced, .. } = *self;
        let batch_size = reduced.config.stage(stage).batch_size;
        let batch = stage_batch(&reduced, stage, batch_size)?;
        let model = freeze(stage, reduced.model());
        let ours = gradients(&model, &batch, DeviceBatch::upload(&batch, &reduced.device.clone().autodiff())?)?;
        let copy = module_in_f64(&model, reference).train();
        let shown = DeviceBatch::upload(&batch, &reference.clone().autodiff())?.in_f64(&reference.clone().autodiff());
        let theirs = gradients(&copy, &batch, shown)?;
        Ok(Some(largest_error(&model, &ours, &theirs)))
    }
}

impl ToF64 for DeviceBatch {
    fn in_f64(&self, reference: &Device) -> Self {
        Self {
            context: self.context.in_f64(reference),
            targets: self.targets.in_f64(reference),
            pictures: self.pictures.in_f64(reference),
        }
    }
}

/// Loss of a batch and the gradient of every parameter, times [`loss_factor`].
pub(crate) fn gradients(
    model: &Clift,
    batch: &StageBatch,
    shown: DeviceBatch,
) -> Result<(f64, GradientsParams), TrainError> {
    let loss = render_loss(model, &shown, &batch.tokens, &Loss::default())?.total;
    let grads = GradientsParams::from_grads(loss.clone().mul_scalar(loss_factor()).backward(), model);
    Ok((values(loss.inner())[0], grads))
}

/// What training in this thread's precision starts to multiply its loss by. A power of two, which changes no relative
/// error; the f64 reference has it too.
pub(crate) fn loss_factor() -> f64 {
    LossScale::of(Precision::current()).map_or(1.0, |scale| scale.factor())
}

/// The largest relative error: of the loss, and of each parameter's gradient against its own largest entry.
fn largest_error(model: &Clift, result: &(f64, GradientsParams), reference: &(f64, GradientsParams)) -> f64 {
    struct Compare<'a> {
        result: &'a GradientsParams,
        reference: &'a GradientsParams,
        errors: Vec<f64>,
    }
    impl ModuleVisitor for Compare<'_> {
        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            match (self.result.get::<D>(param.id), self.reference.get::<D>(param.id)) {
                (Some(result), Some(reference)) => self.errors.push(relative_error(result, reference)),
                (None, None) => {}
                // A gradient that only one of them has is wrong altogether.
                (Some(_), None) | (None, Some(_)) => self.errors.push(f64::INFINITY),
            }
        }
    }
    let ((loss, result), (expected, reference)) = (result, reference);
    let mut compare = Compare { result, reference, errors: vec![(loss - expected).abs() / expected.abs()] };
    model.visit(&mut compare);
    // `f64::max` would pass over NaN.
    compare.errors.into_iter().fold(0.0, |most, error| if error > most || error.is_nan() { error } else { most })
}
