//! Latent K-means: which tokens a scene keeps (paper section 3.2).
//!
//! Distances are matrix products on the device; random numbers are drawn on the host, so a seed gives the
//! same clusters on every run. The host sees one assignment and one distance per token and iteration: it
//! finds empty clusters and decides when to stop.
// B scenes, N tokens, S clusters, D width

use burn::tensor::Tensor;
use serde::{Deserialize, Serialize};

use crate::error::ModelError;
use crate::tokens::clusters::{Clusters, SceneClusters};
use crate::tokens::kmeans::labels::Labels;
use crate::tokens::kmeans::samples::Samples;
use crate::tokens::kmeans::seeding;

/// Settings of latent K-means.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct KMeans {
    /// Most Lloyd iterations.
    pub max_iterations: usize,
    /// A scene is done when an iteration lowers its inertia by less than this fraction.
    pub tolerance: f64,
}

impl Default for KMeans {
    fn default() -> Self {
        Self { max_iterations: 50, tolerance: 1e-4 }
    }
}

/// Result of [`KMeans::fit`].
#[derive(Clone, Debug)]
pub struct KMeansFit {
    /// The clusters of every scene; the centroid of each is the sample nearest to its mean.
    pub clusters: Clusters,
    /// Sum of squared distances of all tokens to their cluster's mean, per scene.
    pub inertia: Vec<f64>,
    /// Lloyd iterations of the slowest scene.
    pub iterations: usize,
}

impl KMeansFit {
    /// Share of a scene's [`total_variance`] that its clusters leave within them, 0 for a scene of equal tokens.
    pub fn error(&self, scene: usize, total_variance: f64) -> f64 {
        if total_variance > 0.0 { self.inertia[scene] / total_variance } else { 0.0 }
    }
}

/// Sum of squared distances of the tokens to their mean, per scene: the inertia of a single cluster.
///
/// # Shapes
/// - `tokens`: `[batch, num_tokens, dim]`
///
/// # Errors
/// [`ModelError::Device`] when the device does not give its values back.
pub fn total_variance(tokens: &Tensor<3>) -> Result<Vec<f64>, ModelError> {
    let [batch, num_tokens, _] = tokens.dims();
    let centred = tokens.clone() - tokens.clone().mean_dim(1);
    // Summed in f64 on the host: thousands of squares of unlike size.
    let squares = centred.square().sum_dim(2).reshape([batch * num_tokens]); // [B, N, D] -> [B * N]
    let squares = squares
        .into_data()
        .convert::<f32>()
        .try_to_vec::<f32>()
        .map_err(|error| ModelError::Device { reason: format!("{error:?}") })?;
    Ok(squares.chunks(num_tokens).map(|scene| scene.iter().copied().map(f64::from).sum()).collect())
}

impl KMeans {
    /// Clusters the tokens of every scene into `num_clusters` groups, none of them empty.
    ///
    /// With `num_clusters = num_tokens` every token is its own cluster and nothing is computed.
    ///
    /// # Shapes
    /// - `tokens`: `[batch, num_tokens, dim]`; `seeds`: one per scene, so that a scene's clusters do
    ///   not depend on the scenes beside it
    ///
    /// # Errors
    /// [`ModelError::BadClusters`] when `num_clusters` is not in `1..=num_tokens` or a token is not
    /// finite.
    pub fn fit(&self, tokens: Tensor<3>, num_clusters: usize, seeds: &[u64]) -> Result<KMeansFit, ModelError> {
        let [batch, num_tokens, dim] = tokens.dims();
        assert_eq!(seeds.len(), batch, "one seed per scene");
        if !(1..=num_tokens).contains(&num_clusters) {
            return Err(ModelError::BadClusters { what: format!("{num_clusters} clusters of {num_tokens} tokens") });
        }
        if num_clusters == num_tokens {
            let clusters = Clusters::new(vec![SceneClusters::identity(num_tokens); batch])?;
            return Ok(KMeansFit { clusters, inertia: vec![0.0; batch], iterations: 0 });
        }
        // Refused before any scene is clustered.
        let scenes = tokens.split(1, 0).into_iter().enumerate().map(|(scene, tokens)| {
            let what = || format!("a token of scene {scene} is not finite");
            Samples::new(tokens.reshape([num_tokens, dim])).ok_or_else(|| ModelError::BadClusters { what: what() })
        });
        let scenes = scenes.collect::<Result<Vec<_>, _>>()?;
        let (mut clusters, mut inertia, mut iterations) = (Vec::new(), Vec::new(), 0);
        for (samples, &seed) in scenes.iter().zip(seeds) {
            let (labels, taken) = self.lloyd(samples, num_clusters, seed);
            clusters.push(labels.nearest_samples(num_clusters)?);
            inertia.push(labels.inertia());
            iterations = iterations.max(taken);
        }
        Ok(KMeansFit { clusters: Clusters::new(clusters)?, inertia, iterations })
    }

    /// Clusters of one scene and how many iterations they took.
    fn lloyd(&self, samples: &Samples, num_clusters: usize, seed: u64) -> (Labels, usize) {
        let start = seeding::seed(samples, num_clusters, seed, seeding::MAX_TABLE_LEN);
        let mut labels = samples.assign(samples.select(&start));
        labels.fill_empty(num_clusters);
        for iteration in 1..=self.max_iterations {
            let mut next = samples.assign(samples.means(&labels, num_clusters));
            next.fill_empty(num_clusters);
            let settled = next.assignment == labels.assignment
                || labels.inertia() - next.inertia() <= self.tolerance * labels.inertia();
            labels = next;
            if settled {
                return (labels, iteration);
            }
        }
        (labels, self.max_iterations)
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use burn::tensor::{Device, TensorData};

    use super::*;
    use crate::testing::{Fixture, cpu_devices, devices, random, to_vec};
    use crate::tokens::kmeans::labels::ROUNDING;

    fn assert_valid(fit: &KMeansFit, num_clusters: usize) {
        for scene in fit.clusters.scenes() {
            let unique: BTreeSet<_> = scene.centroid_index().iter().collect();
            assert_eq!(unique.len(), num_clusters, "centroids are distinct tokens");
            let used: BTreeSet<_> = scene.assignment().iter().collect();
            assert_eq!(used.len(), num_clusters, "no cluster is empty");
        }
    }

    /// Cluster numbers in the order in which the tokens meet them.
    fn renumbered(assignment: &[u32]) -> Vec<usize> {
        let mut met = Vec::new();
        let number = |cluster: &u32| {
            met.iter().position(|other| other == cluster).unwrap_or_else(|| {
                met.push(*cluster);
                met.len() - 1
            })
        };
        assignment.iter().map(number).collect()
    }

    /// Squared distance of every token to the mean of every cluster, in f64: `[N][S]`.
    fn brute_force(tokens: &[Vec<f64>], assignment: &[u32], num_clusters: usize) -> Vec<Vec<f64>> {
        let mut means = vec![vec![0.0; tokens[0].len()]; num_clusters];
        for (cluster, mean) in means.iter_mut().enumerate() {
            let members: Vec<_> = tokens.iter().zip(assignment).filter(|&(_, &own)| own as usize == cluster).collect();
            for (i, value) in mean.iter_mut().enumerate() {
                *value = members.iter().map(|(token, _)| token[i]).sum::<f64>() / members.len() as f64;
            }
        }
        let distance = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum();
        tokens.iter().map(|token| means.iter().map(|mean| distance(token, mean)).collect()).collect()
    }

    /// Mean and standard error.
    fn statistics(values: &[f64]) -> (f64, f64) {
        let count = values.len() as f64;
        let mean = values.iter().sum::<f64>() / count;
        let variance = values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / (count - 1.0);
        (mean, (variance / count).sqrt())
    }

    #[test]
    fn inertia_is_within_one_percent_of_scikit_learns() {
        let fixture = Fixture::open("kmeans");
        for set in ["blobs", "encoder_like"] {
            let reference: Tensor<2> = fixture.tensor_f64(&format!("output.{set}_inertia"), &Device::flex());
            let num_seeds = reference.dims()[1];
            let reference = to_vec(reference);
            for device in devices() {
                let tokens = fixture.tensor::<2>(&format!("input.{set}"), &device).unsqueeze::<3>();
                let counts = fixture.integers("input.num_clusters");
                for (num_clusters, reference) in counts.into_iter().zip(reference.chunks(num_seeds)) {
                    let num_clusters = num_clusters as usize;
                    let inertia: Vec<f64> = (0..20)
                        .map(|seed| {
                            let fit = KMeans::default().fit(tokens.clone(), num_clusters, &[seed]).expect("fits");
                            assert_valid(&fit, num_clusters);
                            fit.inertia[0]
                        })
                        .collect();
                    let ((ours, our_error), (theirs, their_error)) = (statistics(&inertia), statistics(reference));
                    // One start each ends in one of many local minima: 1.5 % standard error at eight blobs.
                    let bound = theirs * 1.01 + 2.0 * our_error.hypot(their_error);
                    assert!(ours <= bound, "{set}, {num_clusters}: {ours} against {theirs}");
                }
            }
        }
    }

    #[test]
    fn a_seed_fixes_the_clusters_whatever_scenes_stand_beside() {
        for device in devices() {
            let tokens = random([3, 60, 8], 5, &device).cast(burn::tensor::DType::F32);
            let all = KMeans::default().fit(tokens.clone(), 7, &[1, 2, 3]).expect("fits");
            let again = KMeans::default().fit(tokens.clone(), 7, &[1, 2, 3]).expect("fits");
            assert_eq!(all.clusters, again.clusters);
            let one = KMeans::default().fit(tokens.narrow(0, 1, 1), 7, &[2]).expect("fits");
            assert_eq!(all.clusters.scenes()[1], one.clusters.scenes()[0]);
        }
    }

    #[test]
    fn one_cluster_and_as_many_as_tokens() {
        for device in devices() {
            let tokens = random([2, 9, 4], 6, &device).cast(burn::tensor::DType::F32);
            let one = KMeans::default().fit(tokens.clone(), 1, &[0, 1]).expect("fits");
            assert_valid(&one, 1);
            let spread = to_vec(tokens.clone().var_bias(1).sum_dim(2));
            assert!((one.inertia[1] - 9.0 * spread[1]).abs() < 1e-4, "{} against {}", one.inertia[1], spread[1]);
            let all = KMeans::default().fit(tokens.clone(), 9, &[0, 1]).expect("fits");
            assert_eq!(all.clusters.scenes()[1], SceneClusters::identity(9));
            let most = KMeans::default().fit(tokens.clone(), 8, &[0, 1]).expect("fits");
            assert_valid(&most, 8);
            assert!(KMeans::default().fit(tokens.clone(), 0, &[0, 1]).is_err());
            assert!(KMeans::default().fit(tokens, 10, &[0, 1]).is_err());
        }
    }

    #[test]
    fn duplicate_tokens_still_give_as_many_distinct_centroids() {
        for device in devices() {
            let tokens = Tensor::<3>::ones([1, 12, 4], &device);
            assert_valid(&KMeans::default().fit(tokens.clone(), 5, &[0]).expect("fits"), 5);
            // Two places only, eight clusters.
            let tokens = Tensor::cat(vec![tokens.clone(), tokens * 3.0], 1);
            let fit = KMeans::default().fit(tokens, 8, &[0]).expect("fits");
            assert_valid(&fit, 8);
            assert!(fit.inertia[0] < 1e-4, "no cluster joins the two places: {}", fit.inertia[0]);
        }
    }

    #[test]
    fn a_fit_run_to_its_end_is_a_local_optimum_of_the_inertia_it_reports() {
        let kmeans = KMeans { max_iterations: 1000, tolerance: -1.0 };
        for device in cpu_devices() {
            let tokens = random([1, 200, 6], 12, &device);
            let fit = kmeans.fit(tokens.clone(), 23, &[4]).expect("fits");
            let tokens: Vec<Vec<f64>> = to_vec(tokens).chunks(6).map(<[f64]>::to_vec).collect();
            let scene = &fit.clusters.scenes()[0];
            let distances = brute_force(&tokens, scene.assignment(), 23);
            let own = |token: usize| distances[token][scene.assignment()[token] as usize];
            let inertia: f64 = (0..200).map(own).sum();
            assert!((fit.inertia[0] - inertia).abs() < 1e-9 * inertia, "{} against {inertia}", fit.inertia[0]);
            for (token, all) in distances.iter().enumerate() {
                let least = all.iter().copied().fold(f64::INFINITY, f64::min);
                assert!(own(token) <= least + 1e-9, "token {token} is not in its nearest cluster");
                let centroid = scene.centroid_index()[scene.assignment()[token] as usize] as usize;
                assert!(
                    own(centroid) <= own(token) * (1.0 + 2.0 * ROUNDING) + 1e-9,
                    "token {token} is nearer to its mean than the centroid"
                );
            }
        }
    }

    #[test]
    fn well_separated_tokens_are_told_apart_on_every_device_in_f32_and_f64() {
        let expected: Vec<usize> = (0..90).map(|token| token % 9).collect();
        for device in devices() {
            let corner = Tensor::<3>::from_floats([[[0.0, 0.0], [0.0, 50.0], [90.0, 0.0]]], &device);
            let corners = Tensor::cat(vec![corner.clone(), corner.clone() - 400.0, corner + 300.0], 1);
            let noise = random([1, 90, 2], 13, &device);
            let tokens = corners.repeat_dim(1, 10).cast(noise.dtype()) + noise;
            for dtype in [tokens.dtype(), burn::tensor::DType::F32] {
                let fit = KMeans::default().fit(tokens.clone().cast(dtype), 9, &[7]).expect("fits");
                assert_eq!(renumbered(fit.clusters.scenes()[0].assignment()), expected, "{dtype:?}");
            }
        }
    }

    #[test]
    fn a_far_outlier_takes_one_cluster_and_leaves_the_others_alone() {
        for device in devices() {
            let near = random([1, 100, 4], 14, &device).cast(burn::tensor::DType::F32);
            let far = Tensor::<3>::full([1, 1, 4], 1e4, &device);
            for seed in 0..5 {
                let fit = KMeans::default().fit(Tensor::cat(vec![near.clone(), far.clone()], 1), 11, &[seed]);
                let fit = fit.expect("fits");
                assert_valid(&fit, 11);
                let assignment = fit.clusters.scenes()[0].assignment();
                assert_eq!(assignment.iter().filter(|&&cluster| cluster == assignment[100]).count(), 1);
            }
        }
    }

    #[test]
    fn no_iteration_allowed_still_gives_clusters() {
        for device in devices() {
            let tokens = random([1, 30, 4], 15, &device).cast(burn::tensor::DType::F32);
            let fit = KMeans { max_iterations: 0, ..KMeans::default() }.fit(tokens, 6, &[0]).expect("fits");
            assert_valid(&fit, 6);
            assert_eq!(fit.iterations, 0);
        }
    }

    #[test]
    fn tokens_far_from_the_origin_cluster_as_they_do_near_it() {
        for device in devices() {
            // Eighths are exact at 4096, so both sets are the same up to the shift.
            let near = (random([1, 40, 4], 8, &device).cast(burn::tensor::DType::F32) * 64.0).round() / 8.0;
            let fit = |tokens| KMeans::default().fit(tokens, 5, &[3]).expect("fits").clusters;
            assert_eq!(fit(near.clone()), fit(near + 4096.0));
        }
    }

    #[test]
    fn a_token_that_is_not_finite_is_refused_with_its_scene() {
        for device in devices() {
            for bad in [f32::NAN, f32::INFINITY, f32::MAX] {
                let tokens = Tensor::<3>::from_floats([[[0.0], [1.0], [2.0]], [[0.0], [1.0], [bad]]], &device);
                let message = KMeans::default().fit(tokens, 2, &[0, 0]).unwrap_err().to_string();
                assert_eq!(message, "bad clusters: a token of scene 1 is not finite");
            }
        }
    }

    #[test]
    fn the_error_is_the_variance_within_clusters_over_the_total() {
        // Tokens of two values at two places, far apart, with a little noise.
        let rows: Vec<[f64; 2]> =
            (0..64).map(|i| [f64::from(i % 2) * 10.0, f64::from(i * 7919 % 101) * 1e-3]).collect();
        let values: Vec<f32> = rows.iter().flatten().map(|&value| value as f32).collect();
        let tokens = Tensor::from_data(TensorData::new(values, [1, 64, 2]), &Device::flex());
        let spread = |rows: &[[f64; 2]]| {
            let mean = [0, 1].map(|i| rows.iter().map(|row| row[i]).sum::<f64>() / rows.len() as f64);
            rows.iter().flat_map(|row| [row[0] - mean[0], row[1] - mean[1]]).map(|d| d * d).sum::<f64>()
        };
        let (even, odd): (Vec<_>, Vec<_>) = rows.iter().partition(|row| row[0] == 0.0);
        let expected = (spread(&even) + spread(&odd)) / spread(&rows);
        let error = |tokens: Tensor<3>| {
            let variance = total_variance(&tokens).unwrap()[0];
            KMeans::default().fit(tokens, 2, &[1]).unwrap().error(0, variance)
        };
        assert!((error(tokens) / expected - 1.0).abs() < 1e-3); // f32
        assert_eq!(error(Tensor::ones([1, 8, 2], &Device::flex())), 0.0, "equal tokens");
    }
}
