//! K-means and the condenser on degenerate clusters.

use burn::tensor::Tensor;
use clift_model::{KMeans, SceneClusters};
use clift_train::{BatchTokens, Stage, TrainError, seeded_clusters, seeded_uniform};

use crate::cases::reference::{ToF64, values};
use crate::doctor::stability::case::{CaseDevices, StabilityCase};
use crate::doctor::stability::updates::{batch, network, stage_error};

pub(crate) const CASES: &[StabilityCase] = &[
    StabilityCase {
        name: "duplicate tokens: 16 clusters of 4 distinct ones",
        breaks: "K-means: distances of zero, empty clusters",
        bound: 1e-6,
        reason: "every token can be its cluster's mean; inertia over the sum of squares, each rounded once",
        run: |devices| inertia_error(devices, 4, 16),
    },
    StabilityCase {
        name: "duplicate tokens: all the same",
        breaks: "K-means: no distance to draw a start by",
        bound: 1e-6,
        reason: "the inertia is zero",
        run: |devices| inertia_error(devices, 1, 8),
    },
    StabilityCase::update("N_s = 1", "a condenser of one centroid: its softmax has one score", |devices| {
        condenser_error(devices, |count| seeded_clusters(count, 1, 0, 0))
    }),
    StabilityCase::update("N_s = N", "no members: equation 2 has no keys", |devices| {
        condenser_error(devices, |count| Ok(SceneClusters::identity(count)))
    }),
    StabilityCase::update("singletons: every cluster but one", "segments without a key beside a full one", |devices| {
        condenser_error(devices, |count| {
            let stored = count / 2;
            let assignment = (0..count).map(|token| if token < stored { token as u32 } else { 0 }).collect();
            Ok(SceneClusters::new(assignment, (0..stored as u32).collect())?)
        })
    }),
    StabilityCase::update("one cluster for all", "a softmax over every token but one", |devices| {
        condenser_error(devices, |count| Ok(SceneClusters::new(vec![0; count], vec![count as u32 / 2])?))
    }),
];

/// Returns the error of the inertia of `distinct` tokens, each repeated many times, relative to the sum of squares.
fn inertia_error(devices: &CaseDevices, distinct: usize, num_clusters: usize) -> Result<f64, TrainError> {
    let (dim, times) = (devices.size.pick(8, 64), devices.size.pick(8, 256));
    let few: Tensor<3> = seeded_uniform([1, distinct, dim], 0, "stability tokens", &devices.device);
    let tokens = Tensor::cat(vec![few; times], 1);
    let fit = |tokens: Tensor<3>| KMeans::default().fit(tokens, num_clusters, &[0]);
    let fitted = fit(tokens.clone())?;
    let expected = fit(tokens.clone().in_f64(&devices.reference))?;
    let squares: f64 = values(tokens).iter().map(|value| value * value).sum();
    Ok(((fitted.inertia[0] - expected.inertia[0]) / squares).abs())
}

/// Returns the error of an update of stage 2 with clusters made by `scene` for a number of tokens.
fn condenser_error(
    devices: &CaseDevices,
    scene: impl Fn(usize) -> Result<SceneClusters, TrainError>,
) -> Result<f64, TrainError> {
    let (mut batch, config) = (batch(devices, 4, 2)?, network(devices));
    let views = &batch.clips[0].context;
    let num_tokens = config.num_tokens(views.num_views(), views.height, views.width)?;
    batch.tokens = BatchTokens::Clusters(vec![scene(num_tokens)?; 2]);
    stage_error(devices, &config, Stage::Stage2, &batch)
}
