//! Seeded inputs that need no data: posed pictures, features, clusters, weights.

use burn::module::{Module, ModuleMapper, Param};
use burn::tensor::{Device, Tensor, TensorData};
use clift_data::{Clip, ClipViews, DMat3, DVec3, Intrinsics, Pose, item_rng, step_rng, uniform_below};
use clift_model::{Clift, ModelConfig, SceneClusters};
use rand::{Rng, RngExt};

use crate::error::TrainError;
use crate::step::batch::{StageBatch, TokenSelection};

/// How many pictures of which size an item has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shape {
    /// Context views.
    pub num_context: usize,
    /// Target views.
    pub num_targets: usize,
    /// Rows and columns of a view.
    pub size: [usize; 2],
}

/// One scene: waves of colour with noise, seen by cameras along an arc.
pub fn seeded_clip(shape: Shape, seed: u64, slot: usize) -> Clip {
    let mut rng = item_rng(seed, 0, slot as u32, 0, "bench pictures");
    let Shape { num_context, num_targets, size } = shape;
    // Targets lie between the contexts.
    let along = |count: usize, view: usize| (2 * view + 1) as f64 / count as f64 - 1.0;
    let context = (0..num_context).map(|view| along(num_context, view)).collect();
    let target = (0..num_targets).map(|view| 0.9 * along(num_targets, view)).collect();
    let context = views(context, size, &mut rng);
    Clip { key: format!("bench-{slot}"), context, target: views(target, size, &mut rng) }
}

/// Views at places in `[-1, 1]` of the arc.
fn views(places: Vec<f64>, [height, width]: [usize; 2], rng: &mut impl Rng) -> ClipViews {
    let focal = width as f64;
    let intrinsics = Intrinsics { fx: focal, fy: focal, cx: focal / 2.0, cy: height as f64 / 2.0 };
    let mut images = Vec::with_capacity(places.len() * height * width * 3);
    for _ in &places {
        let waves: [[f64; 3]; 3] = std::array::from_fn(|_| std::array::from_fn(|_| rng.random_range(0.0..0.4)));
        for row in 0..height {
            for column in 0..width {
                for [across, down, shift] in waves {
                    let phase = across * column as f64 + down * row as f64 + 10.0 * shift;
                    images.push((127.5 + 100.0 * phase.sin() + rng.random_range(-25.0..25.0)) as u8);
                }
            }
        }
    }
    let num_views = places.len();
    ClipViews {
        width,
        height,
        images,
        c2w: places.into_iter().map(pose).collect(),
        intrinsics: vec![intrinsics; num_views],
        frame_index: (0..num_views).collect(),
    }
}

/// The camera at a place of the arc, turned towards its middle.
fn pose(place: f64) -> Pose {
    let rotation = DMat3::from_rotation_y(-0.5 * place);
    Pose { rotation, translation: DVec3::new(place, 0.0, 0.25 * place * place) }
}

/// Clusters drawn at random: every cluster has its own token, every other token any cluster.
pub fn seeded_clusters(
    num_tokens: usize,
    num_clusters: usize,
    seed: u64,
    slot: usize,
) -> Result<SceneClusters, TrainError> {
    let mut rng = item_rng(seed, 0, slot as u32, 0, "bench clusters");
    let centroid_index: Vec<u32> = (0..num_clusters).map(|c| (c * num_tokens / num_clusters) as u32).collect();
    let mut assignment: Vec<u32> = (0..num_tokens).map(|_| uniform_below(&mut rng, num_clusters) as u32).collect();
    for (cluster, &token) in centroid_index.iter().enumerate() {
        assignment[token as usize] = cluster as u32;
    }
    Ok(SceneClusters::new(assignment, centroid_index)?)
}

/// A batch of stage 1 that keeps every token, or of stage 2 where there is a number of stored tokens.
pub fn seeded_batch(
    shape: Shape,
    batch_size: usize,
    num_tokens: usize,
    num_storage_tokens: Option<usize>,
    seed: u64,
) -> Result<StageBatch, TrainError> {
    let tokens = match num_storage_tokens {
        None => TokenSelection::All,
        Some(count) => {
            let scenes = (0..batch_size).map(|slot| seeded_clusters(num_tokens, count, seed, slot));
            TokenSelection::Clusters(scenes.collect::<Result<_, _>>()?)
        }
    };
    let clips = (0..batch_size).map(|slot| seeded_clip(shape, seed, slot)).collect();
    Ok(StageBatch { clips, tokens, skipped: Vec::new() })
}

/// Uniform values in `[-1, 1)`.
pub fn seeded_uniform<const D: usize>(shape: [usize; D], seed: u64, purpose: &str, device: &Device) -> Tensor<D> {
    let mut rng = step_rng(seed, 0, purpose);
    let values: Vec<f32> = (0..shape.iter().product()).map(|_| rng.random_range(-1.0..1.0)).collect();
    Tensor::from_data(TensorData::new(values, shape), device)
}

/// A model on an autodiff device with the seed's initial weights, except that the condenser's gates are open:
/// they start at zero, and behind a closed gate every result and every gradient is zero, in any arithmetic.
pub fn seeded_model(config: &ModelConfig, seed: u64, device: &Device) -> Clift {
    struct OpenGates {
        seed: u64,
        path: Vec<String>,
    }
    impl ModuleMapper for OpenGates {
        fn enter_module(&mut self, name: &str, _container: &str) {
            self.path.push(name.into());
        }
        fn exit_module(&mut self, _name: &str, _container: &str) {
            self.path.pop();
        }
        fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
            if !self.path.iter().any(|name| name == "gate") {
                return param;
            }
            let purpose = self.path.join(".");
            param.map(|weight| {
                let bound = 1.0 / (weight.dims()[0] as f64).sqrt();
                let opened = seeded_uniform(weight.dims(), self.seed, &purpose, &weight.device()).mul_scalar(bound);
                // A leaf again, as parameters are.
                opened.detach().require_grad()
            })
        }
    }
    let model = Clift::new(config, seed, &device.clone().autodiff());
    model.map(&mut OpenGates { seed, path: Vec::new() })
}

#[cfg(test)]
mod tests {
    use burn::module::ModuleVisitor;

    use super::*;

    #[test]
    fn a_clip_has_its_views_rigid_poses_and_the_same_bytes_for_a_seed() {
        let shape = Shape { num_context: 3, num_targets: 2, size: [8, 16] };
        let clip = seeded_clip(shape, 5, 1);
        assert_eq!((clip.context.num_views(), clip.target.num_views()), (3, 2));
        assert_eq!(clip.context.images.len(), 3 * 8 * 16 * 3);
        assert!(clip.context.c2w.iter().all(|pose| pose.orthonormality_defect() < 1e-12));
        assert!(clip.context.c2w.windows(2).all(|pair| pair[0] != pair[1]), "views differ");
        assert_eq!(clip, super::seeded_clip(shape, 5, 1));
        assert_ne!(clip.context.images, super::seeded_clip(shape, 6, 1).context.images);
    }

    #[test]
    fn drawn_clusters_are_valid_at_every_count() {
        for count in [1, 2, 7, 12] {
            let scene = seeded_clusters(12, count, 0, 0).expect("valid");
            assert_eq!(scene.centroid_index().len(), count);
        }
        assert_eq!(seeded_clusters(12, 12, 0, 0).expect("valid"), SceneClusters::identity(12));
    }

    #[test]
    fn no_weight_matrix_is_zero_and_all_train() {
        struct NotZero(usize);
        impl ModuleVisitor for NotZero {
            fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
                assert!(param.val().is_require_grad());
                assert!(D != 2 || param.val().inner().abs().max().into_scalar::<f32>() > 0.0);
                self.0 += 1;
            }
        }
        let config = ModelConfig { dim: 8, num_heads: 2, feed_forward_dim: 8, ..ModelConfig::default() };
        let mut visitor = NotZero(0);
        seeded_model(&config, 0, &Device::flex()).visit(&mut visitor);
        assert!(visitor.0 > 0);
    }
}
