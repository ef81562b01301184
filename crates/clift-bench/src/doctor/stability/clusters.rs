//! K-means and the condenser on clusters that are hard.

use burn::tensor::Tensor;
use clift_model::{KMeans, ModelError, SceneClusters};
use clift_train::{
    Stage, TokenSelection, TrainError, freeze, seeded_batch, seeded_clusters, seeded_model, seeded_uniform,
};

use crate::cases::reference::{ToF64, values};
use crate::doctor::stability::case::{Bound, Case, CaseDevices, Outcome};
use crate::doctor::stability::compare::{most, update_error};
use crate::doctor::stability::updates::{network, num_tokens, shape};

const GRADIENT: Bound = Bound::Most(1e-4);
const GRADIENT_REASON: &str = "an update of stage 2 with open gates: 1e-5 a block";

pub(crate) const CASES: &[Case] = &[
    Case {
        name: "duplicate tokens: 16 clusters of 4 distinct ones",
        breaks: "K-means: distances of zero, empty clusters",
        bound: Bound::Most(1e-6),
        reason: "every token can be its cluster's mean; inertia over the sum of squares, each rounded once",
        run: |place| inertia_of(place, 4, 16),
    },
    Case {
        name: "duplicate tokens: all the same",
        breaks: "K-means: no distance to draw a start by",
        bound: Bound::Most(1e-6),
        reason: "the inertia is zero",
        run: |place| inertia_of(place, 1, 8),
    },
    Case {
        name: "N_s = 1",
        breaks: "a condenser of one centroid: its softmax has one score",
        bound: GRADIENT,
        reason: GRADIENT_REASON,
        run: |place| condensed(place, |count| seeded_clusters(count, 1, 0, 0)),
    },
    Case {
        name: "N_s = N",
        breaks: "no members: equation 2 has no keys",
        bound: GRADIENT,
        reason: GRADIENT_REASON,
        run: |place| condensed(place, |count| Ok(SceneClusters::identity(count))),
    },
    Case {
        name: "N_s = N + 1",
        breaks: "a cluster that cannot have a token",
        bound: Bound::Refused("clusters of"),
        reason: "there is no such clustering",
        run: |place| {
            let tokens = seeded_uniform([1, 8, 4], 0, "stability tokens", &place.device);
            match KMeans::default().fit(tokens, 9, &[0]) {
                Err(error @ ModelError::BadClusters { .. }) => Ok(Outcome::Refused(error.to_string())),
                Err(other) => Err(other.into()),
                Ok(_) => Ok(Outcome::Error(0.0)),
            }
        },
    },
    Case {
        name: "singletons: every cluster but one",
        breaks: "segments without a key beside a full one",
        bound: GRADIENT,
        reason: GRADIENT_REASON,
        run: |place| {
            condensed(place, |count| {
                let stored = count / 2;
                let assignment = (0..count).map(|token| if token < stored { token as u32 } else { 0 }).collect();
                Ok(SceneClusters::new(assignment, (0..stored as u32).collect())?)
            })
        },
    },
    Case {
        name: "one cluster for all",
        breaks: "a softmax over every token but one",
        bound: GRADIENT,
        reason: GRADIENT_REASON,
        run: |place| condensed(place, |count| Ok(SceneClusters::new(vec![0; count], vec![count as u32 / 2])?)),
    },
];

/// The difference of the inertia of clusters of `distinct` tokens, each many times over, from f64.
fn inertia_of(place: &CaseDevices, distinct: usize, num_clusters: usize) -> Result<Outcome, TrainError> {
    let (dim, times) = (place.size.pick(8, 64), place.size.pick(8, 256));
    let few: Tensor<3> = seeded_uniform([1, distinct, dim], 0, "stability tokens", &place.device);
    let tokens = Tensor::cat(vec![few; times], 1);
    let fit = |tokens: Tensor<3>| KMeans::default().fit(tokens, num_clusters, &[0]);
    let ours = fit(tokens.clone())?;
    let theirs = fit(tokens.clone().in_f64(&place.reference))?;
    let squares: f64 = values(tokens).iter().map(|value| value * value).sum();
    Ok(Outcome::Error(most([(ours.inertia[0] - theirs.inertia[0]) / squares].into_iter())))
}

/// The error of an update of stage 2 with these clusters.
fn condensed(
    place: &CaseDevices,
    scene: impl Fn(usize) -> Result<SceneClusters, TrainError>,
) -> Result<Outcome, TrainError> {
    let num_tokens = num_tokens(place, 4);
    let mut batch = seeded_batch(shape(place, 4), 2, num_tokens, None, 0)?;
    batch.tokens = TokenSelection::Clusters(vec![scene(num_tokens)?; 2]);
    let model = freeze(Stage::Stage2, seeded_model(&network(place), 0, &place.device));
    Ok(Outcome::Error(update_error(place, &model, &batch)?))
}
