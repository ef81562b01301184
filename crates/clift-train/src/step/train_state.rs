//! One optimiser update, the same for both stages.

use burn::module::Module;
use burn::optim::lr_scheduler::module_lr_scheduler::ModuleLearningRate;
use burn::optim::{GradientsAccumulator, GradientsParams, ModuleOptimizer};
use burn::tensor::{Device, Tensor};
use clift_model::{Clift, Precision};

use crate::error::TrainError;
use crate::step::activation_checkpointing;
use crate::step::batch::StageBatch;
use crate::step::device_batch::{DeviceBatch, render_loss};
use crate::step::loss::{Loss, LossParts};
use crate::step::loss_scale::LossScale;
use crate::step::optimizer::{clip_factor, norm_on_device, scale};

/// A model with its optimiser on an autodiff device.
pub struct TrainState {
    /// What is trained.
    pub model: Clift,
    /// Its optimiser.
    pub optimizer: ModuleOptimizer,
    /// Where it is trained.
    pub device: Device,
    /// What is minimised.
    pub loss: Loss,
    /// Whether the backward computes every block again instead of keeping what is inside it.
    pub activation_checkpointing: bool,
    /// Of training with f16 products; `None` for f32.
    pub loss_scale: Option<LossScale>,
}

/// What an update did.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Update {
    /// What is minimised, of the batch.
    pub loss: f64,
    /// Mean squared error of the batch.
    pub mse: f64,
    /// Global norm of the gradient before clipping.
    pub grad_norm: f64,
    /// Whether the weights changed.
    pub applied: bool,
}

impl TrainState {
    /// Makes one update from a batch, worked off in `accumulate` parts, unless its loss or gradient is not finite.
    ///
    /// # Errors
    /// As [`TrainState::step_if`].
    pub fn step(
        self,
        batch: &StageBatch,
        accumulate: usize,
        rate: ModuleLearningRate,
        max_grad_norm: f64,
    ) -> Result<(Self, Update), TrainError> {
        self.step_if(batch, accumulate, rate, max_grad_norm, |loss, norm| loss.is_finite() && norm.is_finite())
    }

    /// Makes one update from a batch if `accept` of its loss and gradient norm says so.
    ///
    /// Takes the learner and gives it back, so that the update writes the weights in place.
    ///
    /// # Errors
    /// Whatever the model refuses.
    pub fn step_if(
        self,
        batch: &StageBatch,
        accumulate: usize,
        rate: ModuleLearningRate,
        max_grad_norm: f64,
        accept: impl FnOnce(f64, f64) -> bool,
    ) -> Result<(Self, Update), TrainError> {
        let Self { model, mut optimizer, device, loss, activation_checkpointing, loss_scale } = self;
        let precision = if loss_scale.is_some() { Precision::F16 } else { Precision::F32 };
        let _scope = precision.scope();
        let factor = loss_scale.map_or(1.0, |scale| scale.factor());
        let mut accumulator = GradientsAccumulator::<Clift>::new();
        let mut read = HostReads::default();
        for part in batch.parts(accumulate) {
            let share = part.clips.len() as f64 / batch.clips.len() as f64;
            let shown = DeviceBatch::upload(&part, &device)?;
            let parts = if activation_checkpointing {
                activation_checkpointing::backward(
                    &model,
                    &shown,
                    &part.tokens,
                    &loss,
                    share * factor,
                    &mut accumulator,
                )?
            } else {
                let LossParts { total, mse } = render_loss(&model, &shown, &part.tokens, &loss)?;
                let grads = total.clone().mul_scalar(share * factor).backward();
                accumulator.accumulate(&model, GradientsParams::from_grads(grads, &model));
                LossParts { total: total.inner(), mse: mse.inner() }
            };
            read.add(share, parts);
        }
        let grads = accumulator.grads();
        let Read { loss: total, mse, grad_norm } = read.finish(norm_on_device(&model, &grads))?;
        let grad_norm = grad_norm / factor;
        // Looked at before the update, so that a bad batch leaves no trace in the weights.
        let applied = accept(total, grad_norm);
        let model = if applied {
            let grads = scale(&model, grads, clip_factor(grad_norm, max_grad_norm) / factor);
            optimizer.step(rate, model, grads)
        } else {
            model
        };
        let learner = Self { model, optimizer, device, loss, activation_checkpointing, loss_scale };
        Ok((learner, Update { loss: total, mse, grad_norm, applied }))
    }

    /// Adapts the loss scale to what an update has shown, and says whether it overflowed.
    pub fn adapt_loss_scale(&mut self, update: &Update) -> bool {
        let Some(scale) = &mut self.loss_scale else { return false };
        let is_overflow = !update.applied && scale.is_overflow(update.loss, update.grad_norm);
        match (is_overflow, update.applied) {
            (true, _) => scale.shrink(),
            (false, true) => scale.grow(),
            (false, false) => {}
        }
        is_overflow
    }

    /// The model on its device without autodiff.
    pub fn inference_model(&self) -> Clift {
        self.model.valid()
    }
}

/// The numbers that an update needs on the host. They stay on the device until all are there: every read waits for the
/// work before it, and leaves a GPU without any until the host has queued more.
#[derive(Default)]
struct HostReads {
    shares: Vec<f64>,
    /// Loss and mean squared error of every part.
    values: Vec<Tensor<1>>,
}

/// What [`HostReads`] gives.
struct Read {
    loss: f64,
    mse: f64,
    grad_norm: f64,
}

impl HostReads {
    fn add(&mut self, share: f64, parts: LossParts) {
        self.shares.push(share);
        self.values.extend([parts.total, parts.mse]);
    }

    /// Losses of the whole batch, and the norm, which is zero where nothing is trained.
    fn finish(mut self, grad_norm: Option<Tensor<1>>) -> Result<Read, TrainError> {
        self.values.extend(grad_norm);
        let values = Tensor::cat(self.values, 0).try_into_vec_as::<f64>();
        let values = values.map_err(|error| TrainError::Device { reason: error.to_string() })?;
        let (parts, norm) = values.split_at(2 * self.shares.len());
        let of = |place: usize| parts.iter().skip(place).step_by(2).zip(&self.shares).map(|(v, share)| share * v).sum();
        Ok(Read { loss: of(0), mse: of(1), grad_norm: norm.first().copied().unwrap_or(0.0) })
    }
}
