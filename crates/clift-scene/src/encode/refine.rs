//! Fits the tokens of a capture to its photos, by gradient descent through the renderer. No weight changes.
//!
//! A group of neighbours is fitted to the photos of its own views, and to photos of other groups near it, as frames between
//! the photos are rendered: these hold the geometry that its own photos leave open.
// S stored tokens of a group, D width

use burn::module::Module;
use burn::tensor::{Device, Tensor};
use clift_core::{ClipViews, Pose, ViewDistance, derive_seed, step_rng};
use clift_model::{ModelError, Renderer, Tokens, TrainedModel, Views};
use rand::RngExt;
use rand::distr::weighted::WeightedIndex;

use crate::error::SceneError;
use crate::scene::scene::{ContextGroup, Scene};
use crate::scene::scene_renderer::{group_shares, group_tokens};

const PHOTOS_PER_STEP: usize = 3;
/// Weight of a photo of the group's own views; those of other photos are their shares of the group.
const OWN_WEIGHT: f64 = 0.25;
/// Size of the first step as a share of the root mean square of the tokens; falls to 0. A larger one fits noise.
const RATE: f64 = 0.01;

/// Fits the tokens of a scene of several groups in `steps` steps per group. `context` are images and cameras of all context
/// views. `progress` gets the numbers of fitted and of all groups.
pub(crate) fn refine(
    model: &TrainedModel,
    context: &ClipViews,
    scene: &mut Scene,
    (steps, seed): (usize, u64),
    progress: &mut dyn FnMut(usize, usize),
) -> Result<(), SceneError> {
    let renderer = model.network.renderer.clone().train().no_grad();
    let photos = photos_of_groups(scene);
    progress(0, photos.len());
    for (i, positions) in scene.tokens_of_groups().iter().enumerate() {
        let frame = scene.groups[i].frame;
        let seed = derive_seed(seed, &format!("refine group {i}"));
        let mut fit = GroupFit::new(scene, i, positions, &model.device)?;
        for step in 0..steps {
            let target = ContextGroup { views: choose(&photos[i], seed, step), frame }.members(context);
            fit.step(&renderer, &target, model, [step, steps])?;
        }
        let (dim, values) = (scene.model.dim, fit.tokens.to_host()?);
        for (&token, row) in positions.iter().zip(values.chunks_exact(dim)) {
            scene.tokens[token as usize * dim..][..dim].copy_from_slice(row);
        }
        progress(i + 1, photos.len());
    }
    Ok(())
}

/// Returns the photos that every group is fitted to, with their weights: its own views, and views of other groups of which it
/// has a share when they are rendered without the groups that they belong to, up to twice as far as its own views are.
fn photos_of_groups(scene: &Scene) -> Vec<Vec<(u32, f64)>> {
    let poses: Vec<Pose> = scene.context.iter().map(|camera| camera.c2w).collect();
    let distance = ViewDistance::new(&poses);
    let mut photos: Vec<Vec<(u32, f64)>> =
        scene.groups.iter().map(|group| group.views.iter().map(|&view| (view, OWN_WEIGHT)).collect()).collect();
    for (view, pose) in poses.iter().enumerate() {
        let others: Vec<usize> =
            (0..photos.len()).filter(|&group| !scene.groups[group].views.contains(&(view as u32))).collect();
        let members = |group: usize| scene.groups[group].views.iter().map(|&member| &poses[member as usize]);
        let distances: Vec<f64> = others.iter().map(|&group| distance.to_group(pose, members(group))).collect();
        for (i, share) in group_shares(&distances) {
            let group = others[i];
            let reach = members(group).map(|own| distance.to_group(own, members(group))).fold(0.0, f64::max);
            if distances[i] <= 2.0 * reach {
                photos[group].push((view as u32, share));
            }
        }
    }
    photos
}

/// Draws the photos of a step with replacement, in proportion to their weights.
fn choose(photos: &[(u32, f64)], seed: u64, step: usize) -> Vec<u32> {
    let weights = WeightedIndex::new(photos.iter().map(|(_, weight)| weight)).expect("own views have a weight");
    let drawn = step_rng(seed, step as u64, "photos").sample_iter(weights);
    drawn.take(PHOTOS_PER_STEP).map(|position| photos[position].0).collect()
}

/// The tokens of a group and the moments of Adam.
struct GroupFit {
    /// With the transforms of their patches, `[1, S, D]`.
    tokens: Tokens,
    mean: Tensor<3>,
    square: Tensor<3>,
    /// Root mean square of the values.
    scale: f64,
}

impl GroupFit {
    fn new(scene: &Scene, group: usize, positions: &[u32], device: &Device) -> Result<Self, ModelError> {
        let tokens = group_tokens(scene, group, positions, device)?;
        let (mean, square) = (Tensor::zeros_like(&tokens.values), Tensor::zeros_like(&tokens.values));
        let dim = scene.model.dim;
        let values = positions.iter().flat_map(|&token| &scene.tokens[token as usize * dim..][..dim]);
        let sum: f64 = values.map(|&value| f64::from(value).powi(2)).sum();
        let scale = (sum / (positions.len() * dim) as f64).sqrt();
        Ok(Self { tokens, mean, square, scale })
    }

    /// Makes a step of Adam, from 0, of `num_steps` for the mean squared error of `target`.
    fn step(
        &mut self,
        renderer: &Renderer,
        target: &ClipViews,
        model: &TrainedModel,
        [step, num_steps]: [usize; 2],
    ) -> Result<(), ModelError> {
        const DECAY: [f64; 2] = [0.9, 0.99];
        let views = Views::upload(&[target], &model.device.clone().autodiff())?;
        let values = self.tokens.values.clone().autodiff().require_grad();
        let image = renderer.forward(self.tokens.with_values(values.clone()), &views.cameras);
        let gradients = (image - views.images).powi_scalar(2).mean().backward();
        let gradient = values.grad(&gradients).expect("the image depends on the tokens");
        self.mean = self.mean.clone() * DECAY[0] + gradient.clone() * (1.0 - DECAY[0]);
        self.square = self.square.clone() * DECAY[1] + gradient.powi_scalar(2) * (1.0 - DECAY[1]);
        let [first, second] = DECAY.map(|decay| 1.0 - decay.powi(step as i32 + 1));
        let direction = self.mean.clone() / first / ((self.square.clone() / second).sqrt() + 1e-12);
        let rate = RATE * self.scale * (1.0 - step as f64 / num_steps as f64);
        let values = self.tokens.values.clone() - direction * rate;
        self.tokens = self.tokens.with_values(values);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::scene::tests::scene_of_groups;

    #[test]
    fn groups_are_fitted_to_their_own_photos_and_to_those_near_them() {
        let scene = scene_of_groups();
        let photos = photos_of_groups(&scene);
        for (group, photos) in scene.groups.iter().zip(&photos) {
            let own = photos.iter().filter(|(_, weight)| *weight == OWN_WEIGHT).map(|(view, _)| *view);
            assert_eq!(own.take(group.views.len()).collect::<Vec<_>>(), group.views);
            assert!(photos[group.views.len()..].iter().all(|(view, _)| !group.views.contains(view)), "{photos:?}");
        }
    }
}
