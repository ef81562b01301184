//! One optimiser update, the same for both stages.
// B scenes, T target views, N tokens, K kept tokens, S centroids, D width

use burn::module::Module;
use burn::optim::lr_scheduler::module_lr_scheduler::ModuleLearningRate;
use burn::optim::{GradientsAccumulator, GradientsParams, ModuleOptimizer};
use burn::tensor::{Device, Tensor};
use clift_data::{Clip, Skip};
use clift_eval::{upload_cameras, upload_pictures, upload_views};
use clift_model::{Cameras, Clift, Clusters, Condenser, Precision, RenderTokens, SceneClusters, SceneModel, Views};

use crate::TrainError;
use crate::loss::{Loss, LossParts};
use crate::loss_scale::LossScale;
use crate::optim::{clip_factor, norm_on_device, scale};
use crate::recompute;

/// What one update sees: clips with equal numbers of views, and which tokens the renderer is given.
#[derive(Clone, Debug)]
pub struct StageBatch {
    /// One clip per slot.
    pub clips: Vec<Clip>,
    /// The tokens, slot by slot.
    pub tokens: TokenChoice,
    /// Scenes left out on the way.
    pub skipped: Vec<Skip>,
}

/// Which tokens the renderer is given.
#[derive(Clone, Debug, PartialEq)]
pub enum TokenChoice {
    /// Stage 1: a subset of the scene's tokens for every target view, `[slots][views][K]`.
    Subsets(Vec<Vec<Vec<u32>>>),
    /// Stage 1: every token.
    All,
    /// Stage 2: the condensed centroids of every scene.
    Clusters(Vec<SceneClusters>),
}

impl StageBatch {
    /// Cuts the batch into `count` parts of nearly equal size.
    fn parts(&self, count: usize) -> impl Iterator<Item = Self> + '_ {
        let batch_size = self.clips.len();
        (0..count).map(move |part| {
            let range = part * batch_size / count..(part + 1) * batch_size / count;
            let tokens = match &self.tokens {
                TokenChoice::Subsets(subsets) => TokenChoice::Subsets(subsets[range.clone()].to_vec()),
                TokenChoice::All => TokenChoice::All,
                TokenChoice::Clusters(clusters) => TokenChoice::Clusters(clusters[range.clone()].to_vec()),
            };
            Self { clips: self.clips[range].to_vec(), tokens, skipped: Vec::new() }
        })
    }
}

/// A model with its optimiser on an autodiff device.
pub struct Learner {
    /// What is trained.
    pub model: Clift,
    /// Its optimiser.
    pub optimizer: ModuleOptimizer,
    /// Where it is trained.
    pub device: Device,
    /// What is minimised.
    pub loss: Loss,
    /// Whether the backward computes every block again instead of keeping what is inside it.
    pub recompute: bool,
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

impl Learner {
    /// Makes one update from a batch, worked off in `accumulate` parts, unless its loss or gradient is not finite.
    ///
    /// # Errors
    /// As [`Learner::step_if`].
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
        let Self { model, mut optimizer, device, loss, recompute, loss_scale } = self;
        let precision = if loss_scale.is_some() { Precision::F16 } else { Precision::F32 };
        let _scope = precision.scope();
        let factor = loss_scale.map_or(1.0, |scale| scale.factor());
        let mut accumulator = GradientsAccumulator::<Clift>::new();
        let mut read = ReadOnce::default();
        for part in batch.parts(accumulate) {
            let share = part.clips.len() as f64 / batch.clips.len() as f64;
            let shown = Shown::upload(&part, &device)?;
            let parts = if recompute {
                recompute::backward(&model, &shown, &part.tokens, &loss, share * factor, &mut accumulator)?
            } else {
                let LossParts { total, mse } = loss_of(&model, &shown, &part.tokens, &loss)?;
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
        let learner = Self { model, optimizer, device, loss, recompute, loss_scale };
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
struct ReadOnce {
    shares: Vec<f64>,
    /// Loss and mean squared error of every part.
    values: Vec<Tensor<1>>,
}

/// What [`ReadOnce`] gives.
struct Read {
    loss: f64,
    mse: f64,
    grad_norm: f64,
}

impl ReadOnce {
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

/// What a batch shows, on a device.
pub(crate) struct Shown {
    /// The given views.
    pub context: Views,
    /// Where the targets were taken from.
    pub targets: Cameras,
    /// The targets, `[B, T, H, W, 3]`.
    pub pictures: Tensor<5>,
}

impl Shown {
    /// Copies the views of a batch to a device.
    pub fn upload(batch: &StageBatch, device: &Device) -> Result<Self, TrainError> {
        let contexts: Vec<_> = batch.clips.iter().map(|clip| &clip.context).collect();
        let targets: Vec<_> = batch.clips.iter().map(|clip| &clip.target).collect();
        Ok(Self {
            context: upload_views(&contexts, device)?,
            targets: upload_cameras(&targets, device)?,
            pictures: upload_pictures(&targets, device)?,
        })
    }
}

/// Renders the targets and compares, on the tape.
pub(crate) fn loss_of(
    model: &Clift,
    shown: &Shown,
    choice: &TokenChoice,
    loss: &Loss,
) -> Result<LossParts, TrainError> {
    let lift = model.encode(&shown.context); // [B, N, D]
    let tokens = choice.apply(&model.condenser, lift)?;
    let rendering = model.render(tokens, &shown.targets);
    Ok(loss.of(rendering, shown.pictures.clone()))
}

impl TokenChoice {
    /// What the renderer is given of a scene's tokens.
    pub(crate) fn apply(&self, condenser: &Condenser, lift: Tensor<3>) -> Result<RenderTokens, TrainError> {
        Ok(match self {
            Self::All => lift.into(),
            Self::Subsets(subsets) => RenderTokens::subsets(lift, subsets),
            Self::Clusters(clusters) => {
                let index = Clusters::new(clusters.clone())?.upload(&lift.device());
                condenser.forward(lift, &index).into()
            }
        })
    }
}
