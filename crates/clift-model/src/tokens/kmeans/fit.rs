//! Settings, result and iterations of latent K-means (paper section 3.2).
//!
//! Distances are matrix products on the device. Random numbers come from the host, so that a seed gives the same clusters
//! on every run. The host reads one assignment and one distance per token and iteration, reseeds empty clusters and
//! decides when to stop.
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
    /// Relative decrease of the inertia per iteration below which a scene stops.
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
    /// Clusters of every scene; the centroid is the token nearest to the mean.
    pub clusters: Clusters,
    /// Sum of squared distances of the tokens to the means of their clusters, per scene.
    pub inertia: Vec<f64>,
}

impl KMeans {
    /// Groups the tokens of every scene into `num_clusters` clusters, none of them empty. For
    /// `num_clusters = num_tokens` every token is a cluster.
    ///
    /// # Shapes
    /// - `tokens`: `[batch, num_tokens, dim]`; `seeds`: one per scene, so that the clusters of a scene do not depend on
    ///   the rest of the batch
    pub fn fit(&self, tokens: Tensor<3>, num_clusters: usize, seeds: &[u64]) -> Result<KMeansFit, ModelError> {
        let [batch, num_tokens, dim] = tokens.dims();
        assert_eq!(seeds.len(), batch, "one seed per scene");
        if !(1..=num_tokens).contains(&num_clusters) {
            return Err(ModelError::BadClusters { reason: format!("{num_clusters} clusters of {num_tokens} tokens") });
        }
        if num_clusters == num_tokens {
            let clusters = Clusters::new(vec![SceneClusters::identity(num_tokens); batch])?;
            return Ok(KMeansFit { clusters, inertia: vec![0.0; batch] });
        }
        // All scenes are checked before the first is clustered.
        let scenes = tokens.split(1, 0).into_iter().enumerate().map(|(scene, tokens)| {
            let not_finite = || ModelError::BadClusters { reason: format!("a token of scene {scene} is not finite") };
            Samples::new(tokens.reshape([num_tokens, dim])).ok_or_else(not_finite)
        });
        let scenes = scenes.collect::<Result<Vec<_>, _>>()?;
        let (mut clusters, mut inertia) = (Vec::new(), Vec::new());
        for (samples, &seed) in scenes.iter().zip(seeds) {
            let labels = self.lloyd(samples, num_clusters, seed);
            clusters.push(labels.nearest_samples(num_clusters)?);
            inertia.push(labels.inertia());
        }
        Ok(KMeansFit { clusters: Clusters::new(clusters)?, inertia })
    }

    fn lloyd(&self, samples: &Samples, num_clusters: usize, seed: u64) -> Labels {
        let start = seeding::seed(samples, num_clusters, seed, seeding::MAX_TABLE_LEN);
        let mut labels = samples.assign(samples.select(&start));
        labels.reseed_empty(num_clusters);
        for _ in 0..self.max_iterations {
            let mut next = samples.assign(samples.means(&labels, num_clusters));
            next.reseed_empty(num_clusters);
            let settled = next.assignment == labels.assignment
                || labels.inertia() - next.inertia() <= self.tolerance * labels.inertia();
            labels = next;
            if settled {
                break;
            }
        }
        labels
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use burn::tensor::Device;

    use super::*;
    use crate::testing::{Fixture, devices, random, to_vec};
    use crate::tokens::kmeans::labels::ROUNDING;

    fn assert_valid(fit: &KMeansFit, num_clusters: usize) {
        for scene in fit.clusters.scenes() {
            let unique: BTreeSet<_> = scene.centroid_index().iter().collect();
            assert_eq!(unique.len(), num_clusters, "centroids are distinct tokens");
            let used: BTreeSet<_> = scene.assignment().iter().collect();
            assert_eq!(used.len(), num_clusters, "no cluster is empty");
        }
    }

    fn fit(tokens: &Tensor<3>, num_clusters: usize, seeds: &[u64]) -> KMeansFit {
        KMeans::default().fit(tokens.clone(), num_clusters, seeds).expect("fits")
    }

    /// Computes the squared distance of every token to the mean of every cluster in f64, `[N][S]`.
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

    fn statistics(values: &[f64]) -> (f64, f64) {
        let count = values.len() as f64;
        let mean = values.iter().sum::<f64>() / count;
        let variance = values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / (count - 1.0);
        (mean, (variance / count).sqrt())
    }

    #[test]
    fn inertia_is_within_one_percent_of_scikit_learn() {
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
                            let fit = fit(&tokens, num_clusters, &[seed]);
                            assert_valid(&fit, num_clusters);
                            fit.inertia[0]
                        })
                        .collect();
                    let ((ours, our_error), (theirs, their_error)) = (statistics(&inertia), statistics(reference));
                    // Every start ends in one of many local minima: 1.5 % standard error for eight blobs.
                    let bound = theirs * 1.01 + 2.0 * our_error.hypot(their_error);
                    assert!(ours <= bound, "{set}, {num_clusters}: {ours} against {theirs}");
                }
            }
        }
    }

    #[test]
    fn clusters_depend_on_the_seed_alone() {
        for device in devices() {
            let tokens = random([3, 60, 8], 5, &device).cast(burn::tensor::DType::F32);
            let all = fit(&tokens, 7, &[1, 2, 3]);
            assert_eq!(all.clusters, fit(&tokens, 7, &[1, 2, 3]).clusters);
            let one = fit(&tokens.narrow(0, 1, 1), 7, &[2]);
            assert_eq!(all.clusters.scenes()[1], one.clusters.scenes()[0]);
        }
    }

    #[test]
    fn counts_from_one_to_all_tokens_and_zero_iterations() {
        for device in devices() {
            let tokens = random([2, 9, 4], 6, &device).cast(burn::tensor::DType::F32);
            let one = fit(&tokens, 1, &[0, 1]);
            assert_valid(&one, 1);
            let spread = to_vec(tokens.clone().var_bias(1).sum_dim(2));
            assert!((one.inertia[1] - 9.0 * spread[1]).abs() < 1e-4, "{} against {}", one.inertia[1], spread[1]);
            assert_eq!(fit(&tokens, 9, &[0, 1]).clusters.scenes()[1], SceneClusters::identity(9));
            assert_valid(&fit(&tokens, 8, &[0, 1]), 8);
            let start =
                KMeans { max_iterations: 0, ..KMeans::default() }.fit(tokens.clone(), 6, &[0, 1]).expect("fits");
            assert_valid(&start, 6);
            assert!(KMeans::default().fit(tokens.clone(), 0, &[0, 1]).is_err());
            assert!(KMeans::default().fit(tokens, 10, &[0, 1]).is_err());
        }
    }

    #[test]
    fn a_converged_fit_is_a_local_optimum() {
        let kmeans = KMeans { max_iterations: 1000, tolerance: -1.0 };
        for device in devices() {
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
    fn a_shift_of_all_tokens_preserves_clusters() {
        for device in devices() {
            // Multiples of 1/8 are exact at 4096: both sets are equal up to the shift.
            let near = (random([1, 40, 4], 8, &device).cast(burn::tensor::DType::F32) * 64.0).round() / 8.0;
            assert_eq!(fit(&near, 5, &[3]).clusters, fit(&(near + 4096.0), 5, &[3]).clusters);
        }
    }

    #[test]
    fn non_finite_tokens_are_refused() {
        for device in devices() {
            for bad in [f32::NAN, f32::INFINITY, f32::MAX] {
                let tokens = Tensor::<3>::from_floats([[[0.0], [1.0], [2.0]], [[0.0], [1.0], [bad]]], &device);
                let message = KMeans::default().fit(tokens, 2, &[0, 0]).unwrap_err().to_string();
                assert_eq!(message, "bad clusters: a token of scene 1 is not finite");
            }
        }
    }
}
