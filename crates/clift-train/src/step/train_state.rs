//! One optimizer update, the same for both stages.

use burn::optim::lr_scheduler::module_lr_scheduler::ModuleLearningRate;
use burn::optim::{GradientsAccumulator, GradientsParams, ModuleOptimizer};
use burn::tensor::{Device, Tensor};
use clift_model::{Clift, Precision};

use crate::config::config::OptimizerConfig;
use crate::error::TrainError;
use crate::step::activation_checkpointing;
use crate::step::batch::StageBatch;
use crate::step::device_batch::{DeviceBatch, render_loss};
use crate::step::loss::{Loss, LossParts};
use crate::step::loss_scale::LossScale;
use crate::step::optimizer::{clip_factor, make_optimizer, norm_on_device, scale_gradients};

/// A model with its optimizer on an autodiff device.
pub struct TrainState {
    /// The trained model.
    pub model: Clift,
    /// Its optimizer.
    pub optimizer: ModuleOptimizer,
    /// The autodiff device.
    pub device: Device,
    /// The minimized loss.
    pub loss: Loss,
    /// Whether the backward recomputes every block instead of storing its activations.
    pub activation_checkpointing: bool,
    /// Loss scale of training with f16 products; `None` for f32.
    pub loss_scale: Option<LossScale>,
}

/// Result of an update.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Update {
    /// Loss of the batch.
    pub loss: f64,
    /// Mean squared error of the batch.
    pub mse: f64,
    /// Global norm of the gradient before clipping.
    pub grad_norm: f64,
    /// Whether the weights changed.
    pub applied: bool,
}

impl TrainState {
    /// Makes the state before the first update: mean squared error, f32, activations stored.
    pub fn new(model: Clift, optimizer: &OptimizerConfig, device: Device) -> Self {
        let (optimizer, loss) = (make_optimizer(optimizer), Loss::default());
        Self { model, optimizer, device, loss, activation_checkpointing: false, loss_scale: None }
    }

    /// Makes one update from a batch in `accumulate` micro-batches. An update with a loss or gradient that is not finite is
    /// not applied.
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

    /// Makes one update from a batch and applies it if `accept(loss, grad_norm)`.
    ///
    /// Consumes and returns the state, so that the update writes the weights in place.
    ///
    /// # Errors
    /// Those of the model and of the device.
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
        for (clips, tokens) in batch.parts(accumulate) {
            let share = clips.len() as f64 / batch.clips.len() as f64;
            let device_batch = DeviceBatch::upload(clips, &device)?;
            let parts = if activation_checkpointing {
                activation_checkpointing::backward(
                    &model,
                    &device_batch,
                    &tokens,
                    &loss,
                    share * factor,
                    &mut accumulator,
                )?
            } else {
                let LossParts { total, mse } = render_loss(&model, &device_batch, &tokens, &loss)?;
                let grads = total.clone().mul_scalar(share * factor).backward();
                accumulator.accumulate(&model, GradientsParams::from_grads(grads, &model));
                LossParts { total: total.inner(), mse: mse.inner() }
            };
            read.add(share, parts);
        }
        let grads = accumulator.grads();
        let mut update = read.finish(norm_on_device(&model, &grads))?;
        update.grad_norm /= factor;
        update.applied = accept(update.loss, update.grad_norm);
        let model = if update.applied {
            let grads = scale_gradients(&model, grads, clip_factor(update.grad_norm, max_grad_norm) / factor);
            optimizer.step(rate, model, grads)
        } else {
            model
        };
        Ok((Self { model, optimizer, device, loss, activation_checkpointing, loss_scale }, update))
    }

    /// Adapts the loss scale after an update. Returns whether the update overflowed.
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
}

/// Values of an update that the host needs. They are read together at the end, because each read waits for the queued work
/// and leaves a GPU idle.
#[derive(Default)]
struct HostReads {
    shares: Vec<f64>,
    /// Loss and mean squared error of every part.
    values: Vec<Tensor<1>>,
}

impl HostReads {
    fn add(&mut self, share: f64, parts: LossParts) {
        self.shares.push(share);
        self.values.extend([parts.total, parts.mse]);
    }

    /// Reads the losses of the whole batch and the gradient norm, 0 without gradients, of an update not applied yet.
    fn finish(mut self, grad_norm: Option<Tensor<1>>) -> Result<Update, TrainError> {
        self.values.extend(grad_norm);
        let values = Tensor::cat(self.values, 0).try_into_vec_as::<f64>();
        let values = values.map_err(|error| TrainError::Device { reason: error.to_string() })?;
        let (parts, norm) = values.split_at(2 * self.shares.len());
        let of =
            |offset: usize| parts.iter().skip(offset).step_by(2).zip(&self.shares).map(|(v, share)| share * v).sum();
        let grad_norm = norm.first().copied().unwrap_or(0.0);
        Ok(Update { loss: of(0), mse: of(1), grad_norm, applied: false })
    }
}
