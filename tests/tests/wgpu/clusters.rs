//! Latent K-means.

use burn::tensor::Tensor;
use clift_model::{KMeans, KMeansFit};

use crate::place::{DIM, Place};
use crate::table::{Case, Named, Tolerance, Values};

pub const CASES: &[Case] = &[
    Tolerance::forward(0.0, "the nearest mean is the nearest by more than rounding").case(
        "K-means: cluster of every token, centroids",
        |place| {
            let mut values = scattered(place);
            if place.is_wrong {
                // One token moves to where another cluster is.
                let (first, second) = values.split_at_mut(DIM);
                first.copy_from_slice(&second[..DIM]);
            }
            labels(&fit(place, values, 48, 6))
        },
    ),
    Tolerance::forward(1e-5, "squared distances of 4 from sums of 60: a digit is lost").case(
        "K-means: inertia",
        |place| {
            let mut values = scattered(place);
            if place.is_wrong {
                values[0] += 0.3;
            }
            named([("inertia", fit(place, values, 48, 6).inertia)])
        },
    ),
    Tolerance::forward(0.0, "whole numbers, of which every sum is exact; of equally near means the first is taken")
        .case("K-means: ties, more clusters than different tokens", |place| {
            // Four different tokens in each scene of 16, unordered; the wrong input changes the first.
            let first = usize::from(place.is_wrong);
            let kind = |i: usize| if i == 0 { first } else { i * (i + 1) / 2 % 4 };
            let token = |i: usize| (0..DIM).map(move |d| (kind(i) * (d % 3)) as f32 - 1.0);
            let values = (0..2 * 16).flat_map(token).collect();
            labels(&fit(place, values, 16, 7))
        }),
];

/// Tokens of two scenes around six centres each.
fn scattered(place: &Place) -> Vec<f32> {
    let noise = crate::place::values(place.random([2, 48, DIM], 3));
    let centre = |i: usize| (i / DIM % 6 * 7 + i % DIM * 5) as f32;
    noise.iter().enumerate().map(|(i, noise)| 2.0 * centre(i).sin() + 0.3 * *noise as f32).collect()
}

fn fit(place: &Place, values: Vec<f32>, num_tokens: usize, num_clusters: usize) -> KMeansFit {
    let tokens: Tensor<3> = place.tensor(values, [2, num_tokens, DIM]).inner();
    KMeans::default().fit(tokens, num_clusters, &[11, 12]).expect("finite tokens")
}

fn labels(fit: &KMeansFit) -> Values {
    let scenes = fit.clusters.scenes();
    let numbers = |ids: &[u32]| ids.iter().copied().map(f64::from).collect::<Vec<_>>();
    let assignment = scenes.iter().flat_map(|scene| numbers(scene.assignment())).collect();
    let centroids = scenes.iter().flat_map(|scene| numbers(scene.centroid_index())).collect();
    named([("assignment", assignment), ("centroids", centroids)])
}

fn named<const COUNT: usize>(tensors: [(&str, Vec<f64>); COUNT]) -> Values {
    let forward: Named = tensors.into_iter().map(|(name, values)| (name.to_owned(), values)).collect();
    Values { forward, ..Values::default() }
}
