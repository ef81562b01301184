//! One optimizer update, the same for both stages.

use burn::module::Module;
use burn::optim::lr_scheduler::module_lr_scheduler::ModuleLearningRate;
use burn::optim::{GradientsAccumulator, GradientsParams};
use burn::tensor::{Device, Tensor};
use clift_model::{Network, Precision, has_threads, map_in_threads};

use crate::config::config::OptimizerConfig;
use crate::distributed::parts::BatchParts;
use crate::distributed::ranks::Ranks;
use crate::error::TrainError;
use crate::step::batch::{MicroBatch, StageBatch};
use crate::step::device_batch::{DeviceBatch, render_loss};
use crate::step::gradient_sum::GradientSum;
use crate::step::loss::{Loss, LossParts};
use crate::step::loss_scale::LossScale;
use crate::step::optimizer::{StageOptimizer, clip_factor, norm_on_device};

/// A model with its optimizer on an autodiff device.
pub struct TrainState {
    /// The trained model.
    pub model: Network,
    /// Its optimizer.
    pub optimizer: StageOptimizer,
    /// The autodiff device.
    pub device: Device,
    /// The minimized loss.
    pub loss: Loss,
    /// Operands of matrix products.
    pub precision: Precision,
    /// Loss scale of training with f16 products; `None` for others.
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
    /// Makes the state before the first update: mean squared error, f32.
    pub fn new(model: Network, optimizer: &OptimizerConfig, device: Device) -> Self {
        let (optimizer, loss) = (StageOptimizer::new(optimizer, &device), Loss::default());
        Self { model, optimizer, device, loss, precision: Precision::F32, loss_scale: None }
    }

    /// Makes one update from a batch in `accumulate` micro-batches. An update with a loss or gradient that is not finite is
    /// not applied.
    pub fn step(
        self,
        batch: &StageBatch,
        accumulate: usize,
        rate: ModuleLearningRate,
        max_grad_norm: f64,
    ) -> Result<(Self, Update), TrainError> {
        let ranks = Ranks::single();
        let parts = BatchParts::new(batch.clips.len(), accumulate, &ranks);
        let accept = |loss: f64, norm: f64| loss.is_finite() && norm.is_finite();
        self.step_if(batch, (parts, &ranks), rate, max_grad_norm, accept)
    }

    /// Makes one update from the batch of all ranks, of which `batch` has the slots of this one, and applies it if
    /// `accept(loss, grad_norm)`. Every rank makes the same update of the same weights.
    ///
    /// Consumes and returns the state, so that the update writes the weights in place.
    pub fn step_if(
        self,
        batch: &StageBatch,
        (parts, ranks): (BatchParts, &Ranks),
        rate: ModuleLearningRate,
        max_grad_norm: f64,
        accept: impl FnOnce(f64, f64) -> bool,
    ) -> Result<(Self, Update), TrainError> {
        let Self { model, mut optimizer, device, loss, precision, loss_scale } = self;
        let _scope = precision.scope();
        let factor = loss_scale.map_or(1.0, |scale| scale.factor());
        let mut accumulator = GradientsAccumulator::<Network>::new();
        let mut sum = (ranks.num_ranks() > 1).then(GradientSum::default);
        let (mut shares, mut values) = (Vec::new(), Vec::new());
        let differentiate = |micro_batch: &Option<MicroBatch>| -> Result<_, TrainError> {
            let Some(MicroBatch { clips, tokens, share }) = micro_batch else { return Ok(None) };
            // Autodiff locks the graph of a parameter: with parameters of their own, threads do not wait for each other.
            let model = model.clone().fork(&device);
            let device_batch = DeviceBatch::upload(clips, &device)?;
            let LossParts { total, mse } = render_loss(&model, &device_batch, tokens, &loss, batch.step)?;
            let grads = total.clone().mul_scalar(share * factor).backward();
            Ok(Some((GradientsParams::from_grads(grads, &model), *share, [total.inner(), mse.inner()])))
        };
        let num_pixels = batch.clips.first().map_or(0, |clip| clip.context.images.len() / 3);
        let num_context_patches = num_pixels / model.renderer.patch_size().pow(2);
        let at_once = num_at_once(device == Device::flex().autodiff(), num_context_patches);
        let rounds: Vec<_> = batch.rounds(parts).enumerate().collect();
        for rounds in rounds.chunks(at_once) {
            let results = map_in_threads(at_once > 1, rounds, |(_, micro_batch)| differentiate(micro_batch))?;
            for ((round, _), result) in rounds.iter().zip(results) {
                if let Some((grads, share, losses)) = result {
                    accumulator.accumulate(&model, grads);
                    shares.push(share);
                    values.extend(losses);
                }
                if let Some(sum) = &mut sum {
                    sum.add(&model, accumulator.grads(), parts.num_working(*round), ranks)?;
                }
            }
        }
        let grads = match sum {
            Some(sum) => sum.finish(&model, &device, ranks),
            None => accumulator.grads(),
        };
        let mut update = read_update(&shares, values, norm_on_device(&model, &grads), ranks)?;
        update.grad_norm /= factor;
        update.applied = accept(update.loss, update.grad_norm);
        let model = if update.applied {
            optimizer.step(rate, model, grads, clip_factor(update.grad_norm, max_grad_norm) / factor)
        } else {
            model
        };
        Ok((Self { model, optimizer, device, loss, precision, loss_scale }, update))
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

/// Returns the number of micro-batches that are computed at once; they are in memory together.
pub(crate) fn num_at_once(is_flex: bool, num_context_patches: usize) -> usize {
    if has_threads(is_flex, num_context_patches) { rayon::current_num_threads() } else { 1 }
}

/// Reads the losses and mean squared errors of all parts, added in the order of the parts, and the gradient norm of rank 0,
/// which decides for all; 0 without gradients. The update is not applied yet. All are read together at the end, because each
/// read waits for the queued work and leaves a GPU idle.
fn read_update(
    shares: &[f64],
    mut values: Vec<Tensor<1>>,
    grad_norm: Option<Tensor<1>>,
    ranks: &Ranks,
) -> Result<Update, TrainError> {
    values.extend(grad_norm);
    let values = if values.is_empty() { Ok(Vec::new()) } else { Tensor::cat(values, 0).try_into_vec_as::<f64>() };
    let values = values.map_err(|error| TrainError::Device { reason: error.to_string() })?;
    let (losses, norm) = values.split_at(2 * shares.len());
    let losses = losses.as_chunks::<2>().0.iter().zip(shares);
    let own: Vec<_> = losses.map(|(of, share)| of.map(|value| share * value)).collect();
    let all = ranks.gather((own, norm.first().copied().unwrap_or(0.0)))?;
    let num_rounds = all[0].0.len();
    let of = |i: usize| {
        let in_order = (0..num_rounds).flat_map(|round| all.iter().filter_map(move |(losses, _)| losses.get(round)));
        in_order.map(|losses| losses[i]).sum()
    };
    Ok(Update { loss: of(0), mse: of(1), grad_norm: all[0].1, applied: false })
}

#[cfg(test)]
mod tests {
    use clift_model::{ModelConfig, weights_hash};

    use super::*;
    use crate::events::Stage;
    use crate::stage::settings::freeze;
    use crate::step::seeded_inputs::{ClipShape, seeded_batch, seeded_model};

    #[test]
    fn threads_make_the_update_of_one_thread_in_its_precision() {
        let batch = seeded_batch(ClipShape { num_context: 2, num_targets: 2, size: [16, 16] }, 5, None, 1).unwrap();
        let weights = |num_threads: usize, precision: Precision| {
            let model = freeze(Stage::Stage1, seeded_model(&ModelConfig::small(), 3, &Device::flex()));
            let mut state = TrainState::new(model, &OptimizerConfig::default(), Device::flex().autodiff());
            state.precision = precision;
            let threads = rayon::ThreadPoolBuilder::new().num_threads(num_threads).build().unwrap();
            let (state, update) = threads.install(|| state.step(&batch, 5, 1e-4.into(), 1.0)).unwrap();
            assert!(update.applied);
            weights_hash(&state.model)
        };
        let expected = weights(1, Precision::Bf16);
        assert!([2, 3, 8].into_iter().all(|num_threads| weights(num_threads, Precision::Bf16) == expected));
        assert_ne!(weights(3, Precision::F32), expected);
    }
}
