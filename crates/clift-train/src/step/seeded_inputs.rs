//! Inputs from a seed for tests and benchmarks: posed images, clusters, batches, weights.

use burn::module::{Module, ModuleMapper, Param};
use burn::tensor::{Device, Tensor, TensorData};
use clift_core::{Camera, ClipViews, DMat3, DVec3, Intrinsics, Pose, item_rng, step_rng, uniform_below};
use clift_data::Clip;
use clift_model::{ModelConfig, Network, SceneClusters};
use rand::{Rng, RngExt};

use crate::error::TrainError;
use crate::step::batch::{BatchTokens, StageBatch};

/// Numbers and size of the views of a scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ClipShape {
    /// Context views.
    pub num_context: usize,
    /// Target views.
    pub num_targets: usize,
    /// Rows and columns of a view.
    pub size: [usize; 2],
}

/// Makes a scene: noisy colour waves, seen by cameras along an arc.
pub fn seeded_clip(shape: ClipShape, seed: u64, slot: usize) -> Clip {
    let mut rng = item_rng(seed, 0, slot as u32, 0, "bench pictures");
    let ClipShape { num_context, num_targets, size } = shape;
    // Targets between the contexts.
    let along = |count: usize, view: usize| (2 * view + 1) as f64 / count as f64 - 1.0;
    let context = (0..num_context).map(|view| along(num_context, view)).collect();
    let target = (0..num_targets).map(|view| 0.9 * along(num_targets, view)).collect();
    let context = views(context, size, &mut rng);
    Clip { key: format!("bench-{slot}"), context, target: views(target, size, &mut rng), target_weights: None }
}

/// Makes views at positions in `[-1, 1]` of the arc.
fn views(positions: Vec<f64>, [height, width]: [usize; 2], rng: &mut impl Rng) -> ClipViews {
    let focal = width as f64;
    let intrinsics = Intrinsics { fx: focal, fy: focal, cx: focal / 2.0, cy: height as f64 / 2.0 };
    let mut images = Vec::with_capacity(positions.len() * height * width * 3);
    for _ in &positions {
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
    let num_views = positions.len();
    // Turned towards the centre of the arc.
    let pose = |position: f64| Pose {
        rotation: DMat3::from_rotation_y(-0.5 * position),
        translation: DVec3::new(position, 0.0, 0.25 * position * position),
    };
    ClipViews {
        width,
        height,
        images,
        cameras: positions.into_iter().map(|position| Camera { c2w: pose(position), intrinsics }).collect(),
        frame_index: (0..num_views).collect(),
    }
}

/// Makes random clusters: every cluster has one token of its own, the other tokens have any cluster.
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

/// Makes a batch of stage 1 with all tokens, or of stage 2 if the numbers of tokens and of clusters of a scene are given.
pub fn seeded_batch(
    shape: ClipShape,
    batch_size: usize,
    clusters: Option<[usize; 2]>,
    seed: u64,
) -> Result<StageBatch, TrainError> {
    let tokens = match clusters {
        None => BatchTokens::All,
        Some([num_tokens, count]) => {
            let scenes = (0..batch_size).map(|slot| seeded_clusters(num_tokens, count, seed, slot));
            BatchTokens::Clusters(scenes.collect::<Result<_, _>>()?)
        }
    };
    let clips = (0..batch_size).map(|slot| seeded_clip(shape, seed, slot)).collect();
    Ok(StageBatch { step: 0, clips, tokens, skipped: Vec::new() })
}

/// Samples uniform values in `[-1, 1)`.
pub fn seeded_uniform<const D: usize>(shape: [usize; D], seed: u64, purpose: &str, device: &Device) -> Tensor<D> {
    let mut rng = step_rng(seed, 0, purpose);
    let values: Vec<f32> = (0..shape.iter().product()).map(|_| rng.random_range(-1.0..1.0)).collect();
    Tensor::from_data(TensorData::new(values, shape), device)
}

/// Makes a model with seeded initial weights on the autodiff device. The gates of the condenser get random weights: their
/// initial zeros would make all results and gradients behind them zero.
pub fn seeded_model(config: &ModelConfig, seed: u64, device: &Device) -> Network {
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
                opened.detach().require_grad()
            })
        }
    }
    Network::new(config, seed, &device.clone().autodiff()).map(&mut OpenGates { seed, path: Vec::new() })
}
