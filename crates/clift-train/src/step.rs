//! One optimiser update, the same for both stages.
// B scenes, T target views, N tokens, K kept tokens, S centroids, D width

use burn::module::Module;
use burn::optim::lr_scheduler::module_lr_scheduler::ModuleLearningRate;
use burn::optim::{GradientsAccumulator, GradientsParams, ModuleOptimizer};
use burn::tensor::{Device, Int, Tensor, TensorData};
use clift_data::{Clip, Skip};
use clift_eval::{upload_cameras, upload_pictures, upload_views};
use clift_model::{Cameras, Clift, Clusters, SceneClusters, Views};

use crate::TrainError;
use crate::loss::mse;
use crate::optim::{clip_global_norm, global_norm};

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
}

/// What an update did.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Update {
    /// Mean squared error of the batch.
    pub loss: f64,
    /// Global norm of the gradient before clipping.
    pub grad_norm: f64,
    /// Whether the weights changed: not if loss or gradient were not finite.
    pub applied: bool,
}

impl Learner {
    /// Makes one update from a batch, worked off in `accumulate` parts.
    ///
    /// # Errors
    /// Whatever the model refuses.
    pub fn step(
        &mut self,
        batch: &StageBatch,
        accumulate: usize,
        rate: ModuleLearningRate,
        max_grad_norm: f64,
    ) -> Result<Update, TrainError> {
        let mut accumulator = GradientsAccumulator::<Clift>::new();
        let mut total = 0.0;
        for part in batch.parts(accumulate) {
            let share = part.clips.len() as f64 / batch.clips.len() as f64;
            let loss = self.loss(&part)?.mul_scalar(share);
            let grads = GradientsParams::from_grads(loss.backward(), &self.model);
            accumulator.accumulate(&self.model, grads);
            total += loss.into_scalar::<f64>();
        }
        let grads = accumulator.grads();
        let grad_norm = global_norm(&self.model, &grads);
        // Looked at before the update, so that a bad batch leaves no trace in the weights.
        let applied = total.is_finite() && grad_norm.is_finite();
        if applied {
            let grads = clip_global_norm(&self.model, grads, grad_norm, max_grad_norm);
            self.model = self.optimizer.step(rate, self.model.clone(), grads);
        }
        Ok(Update { loss: total, grad_norm, applied })
    }

    /// Renders the targets of a batch and compares: a scalar on the tape.
    fn loss(&self, batch: &StageBatch) -> Result<Tensor<1>, TrainError> {
        loss_of(&self.model, &Shown::upload(batch, &self.device)?, &batch.tokens)
    }

    /// The model on its device without autodiff.
    pub fn inference_model(&self) -> Clift {
        self.model.valid()
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

/// Renders the targets and compares.
pub(crate) fn loss_of(model: &Clift, shown: &Shown, tokens: &TokenChoice) -> Result<Tensor<1>, TrainError> {
    let lift = model.encoder.forward(&shown.context); // [B, N, D]
    let tokens = match tokens {
        TokenChoice::All => lift,
        TokenChoice::Subsets(subsets) => keep(lift, subsets), // [BT, K, D]
        TokenChoice::Clusters(clusters) => {
            let index = Clusters::new(clusters.clone())?.upload(&lift.device());
            model.condenser.forward(lift, &index) // [B, S, D]
        }
    };
    let rendering = model.renderer.forward(tokens, &shown.targets);
    Ok(mse(rendering, shown.pictures.clone()))
}

/// The kept tokens of every target view: `[B, N, D] -> [B * T, K, D]`.
fn keep(lift: Tensor<3>, subsets: &[Vec<Vec<u32>>]) -> Tensor<3> {
    let [batch, num_tokens, dim] = lift.dims();
    let rows: Vec<i64> = subsets
        .iter()
        .enumerate()
        .flat_map(|(scene, views)| views.iter().flatten().map(move |&token| (scene, token)))
        .map(|(scene, token)| (scene * num_tokens) as i64 + i64::from(token))
        .collect();
    let groups: usize = subsets.iter().map(Vec::len).sum();
    let count = rows.len();
    let rows = Tensor::<1, Int>::from_data(TensorData::new(rows, [count]), &lift.device());
    lift.reshape([batch * num_tokens, dim]).select(0, rows).reshape([groups, count / groups, dim])
}
