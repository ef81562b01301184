//! Latent K-means: which tokens a scene keeps (paper section 3.2).
//!
//! Distances are matrix products on the device; seeding is greedy k-means++ driven by random numbers
//! drawn on the host, so a seed gives the same clusters on every run. The host sees one assignment
//! and one distance per token and iteration: it finds empty clusters and decides when to stop.
// B scenes, N tokens, S clusters, D width, L candidates of one seeding step

use burn::tensor::{Device, IndexingUpdateOp, Int, Tensor, TensorData};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use crate::{Clusters, ModelError, SceneClusters};

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
pub struct Fit {
    /// The clusters of every scene; the centroid of each is the sample nearest to its mean.
    pub clusters: Clusters,
    /// Sum of squared distances of all tokens to their cluster's mean, per scene.
    pub inertia: Vec<f64>,
    /// Lloyd iterations of the slowest scene.
    pub iterations: usize,
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
    pub fn fit(&self, tokens: Tensor<3>, num_clusters: usize, seeds: &[u64]) -> Result<Fit, ModelError> {
        let [batch, num_tokens, _dim] = tokens.dims();
        assert_eq!(seeds.len(), batch, "one seed per scene");
        if !(1..=num_tokens).contains(&num_clusters) {
            return Err(ModelError::BadClusters { what: format!("{num_clusters} clusters of {num_tokens} tokens") });
        }
        if num_clusters == num_tokens {
            let clusters = Clusters::new(vec![SceneClusters::identity(num_tokens); batch])?;
            return Ok(Fit { clusters, inertia: vec![0.0; batch], iterations: 0 });
        }
        // Distances are differences of squares: taken about the mean they lose the fewest digits.
        let tokens = tokens.clone() - tokens.mean_dim(1);
        let samples = Samples::new(tokens)?;
        let means = samples.seed(num_clusters, seeds);
        self.lloyd(&samples, means)
    }

    fn lloyd(&self, samples: &Samples, mut means: Tensor<3>) -> Result<Fit, ModelError> {
        let [batch, num_clusters, _dim] = means.dims();
        let mut done: Vec<Option<Labels>> = vec![None; batch];
        let mut previous: Vec<Option<Labels>> = vec![None; batch];
        for iteration in 0.. {
            let labels = samples.assign(&means);
            for ((mut labels, done), previous) in labels.into_iter().zip(&mut done).zip(&mut previous) {
                if done.is_some() {
                    continue;
                }
                labels.fill_empty(num_clusters);
                let settled = previous.as_ref().is_some_and(|previous| {
                    previous.assignment == labels.assignment
                        || previous.inertia() - labels.inertia() <= self.tolerance * previous.inertia()
                });
                if settled || iteration == self.max_iterations {
                    *done = Some(labels.clone());
                }
                *previous = Some(labels);
            }
            if let Some(finished) = done.iter().cloned().collect::<Option<Vec<Labels>>>() {
                let scenes = finished.iter().map(|labels| labels.nearest_samples(num_clusters));
                let clusters = Clusters::new(scenes.collect::<Result<_, _>>()?)?;
                let inertia = finished.iter().map(Labels::inertia).collect();
                return Ok(Fit { clusters, inertia, iterations: iteration });
            }
            let current: Vec<&Labels> = previous.iter().flatten().collect();
            means = samples.means(&current, num_clusters);
        }
        unreachable!("the loop returns at the last iteration")
    }
}

/// What the host knows of one scene after an assignment.
#[derive(Clone, Debug)]
struct Labels {
    assignment: Vec<u32>,
    /// Squared distance of every token to its cluster's mean.
    distance: Vec<f32>,
}

impl Labels {
    fn inertia(&self) -> f64 {
        self.distance.iter().map(|&d| f64::from(d)).sum()
    }

    /// Gives every empty cluster the token farthest from its own mean, out of clusters that can spare
    /// one. Lower ids first on ties.
    fn fill_empty(&mut self, num_clusters: usize) {
        let mut counts = vec![0_usize; num_clusters];
        self.assignment.iter().for_each(|&cluster| counts[cluster as usize] += 1);
        if !counts.contains(&0) {
            return;
        }
        let mut farthest: Vec<usize> = (0..self.assignment.len()).collect();
        farthest.sort_by(|&a, &b| self.distance[b].total_cmp(&self.distance[a]).then(a.cmp(&b)));
        let mut candidates = farthest.into_iter();
        for cluster in 0..num_clusters {
            if counts[cluster] > 0 {
                continue;
            }
            // There are at least as many tokens as clusters, so one of them can be spared.
            let Some(token) = candidates.find(|&token| counts[self.assignment[token] as usize] > 1) else { break };
            counts[self.assignment[token] as usize] -= 1;
            counts[cluster] = 1;
            self.assignment[token] = cluster as u32;
            self.distance[token] = 0.0;
        }
    }

    /// Keeps the sample nearest to every mean; the lower id on ties.
    fn nearest_samples(&self, num_clusters: usize) -> Result<SceneClusters, ModelError> {
        let mut nearest: Vec<Option<usize>> = vec![None; num_clusters];
        for (token, &cluster) in self.assignment.iter().enumerate() {
            let best = &mut nearest[cluster as usize];
            if best.is_none_or(|best| self.distance[token] < self.distance[best]) {
                *best = Some(token);
            }
        }
        let centroids = nearest.into_iter().flatten().map(|token| token as u32).collect();
        SceneClusters::new(self.assignment.clone(), centroids)
    }
}

/// The tokens with their squared lengths.
struct Samples {
    /// `[B, N, D]`
    tokens: Tensor<3>,
    /// `[B, N, 1]`
    squares: Tensor<3>,
}

impl Samples {
    /// # Errors
    /// [`ModelError::BadClusters`] when a squared length is not finite.
    fn new(tokens: Tensor<3>) -> Result<Self, ModelError> {
        let num_tokens = tokens.dims()[1];
        let squares = tokens.clone().square().sum_dim(2);
        let lengths: Vec<f32> = squares.to_data().convert::<f32>().try_to_vec().expect("converted to f32");
        if let Some(token) = lengths.iter().position(|length| !length.is_finite()) {
            let what = format!("a token of scene {} is not finite", token / num_tokens);
            return Err(ModelError::BadClusters { what });
        }
        Ok(Self { tokens, squares })
    }

    fn device(&self) -> Device {
        self.tokens.device()
    }

    /// Squared distances `|x|^2 - 2 x c + |c|^2`, rounded up to zero: `[B, N, D], [B, S, D] -> [B, N, S]`.
    fn distances(&self, centers: Tensor<3>) -> Tensor<3> {
        let squares = centers.clone().square().sum_dim(2).swap_dims(1, 2); // [B, 1, S]
        let products = self.tokens.clone().matmul(centers.swap_dims(1, 2));
        (self.squares.clone() - products.mul_scalar(2.0) + squares).clamp_min(0.0)
    }

    /// Greedy k-means++: each step draws `2 + ln(S)` candidates with probability proportional to the
    /// squared distance to the centers so far and keeps the one that lowers the sum the most.
    fn seed(&self, num_clusters: usize, seeds: &[u64]) -> Tensor<3> {
        let [batch, num_tokens, dim] = self.tokens.dims();
        let candidates = 2 + (num_clusters as f64).ln() as usize;
        let device = self.device();
        let mut first = Vec::with_capacity(batch);
        let mut thresholds = Vec::with_capacity(batch * num_clusters * candidates);
        for (scene, &seed) in seeds.iter().enumerate() {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            first.push((scene * num_tokens + rng.random_range(0..num_tokens)) as i64);
            thresholds.extend((1..num_clusters).flat_map(|_| 0..candidates).map(|_| rng.random_range(0.0..1.0_f32)));
        }
        let steps = num_clusters - 1;
        let thresholds = TensorData::new(thresholds, [batch, steps, candidates]);
        let thresholds = Tensor::<3>::from_data(thresholds, (&device, self.tokens.dtype()));
        let first = Tensor::<1, Int>::from_data(TensorData::new(first, [batch]), &device);
        // Row of scene b's first token, to index all scenes' tokens at once.
        let offset = Tensor::<1, Int>::arange_step(0..(batch * num_tokens) as i64, num_tokens, &device);
        let offset = offset.reshape([batch, 1]);
        let flat = self.tokens.clone().reshape([batch * num_tokens, dim]);

        let mut centers = vec![flat.clone().select(0, first).reshape([batch, 1, dim])];
        let mut nearest = self.distances(centers[0].clone()); // [B, N, 1]
        for step in 0..steps {
            let cumulative = nearest.clone().squeeze_dim::<2>(2).cumsum(1).reshape([batch, num_tokens, 1]);
            let total = cumulative.clone().narrow(1, num_tokens - 1, 1);
            let threshold = thresholds.clone().narrow(1, step, 1) * total; // [B, 1, L]
            let drawn = cumulative.lower_equal(threshold).int().sum_dim(1).clamp_max((num_tokens - 1) as i64);
            let rows = drawn.squeeze_dim::<2>(1) + offset.clone(); // [B, L]
            let drawn = flat.clone().select(0, rows.reshape([batch * candidates])).reshape([batch, candidates, dim]);
            let after = self.distances(drawn.clone()).min_pair(nearest.expand([batch, num_tokens, candidates]));
            let best = after.clone().sum_dim(1).argmin(2); // [B, 1, 1]
            nearest = after.gather(2, best.clone().expand([batch, num_tokens, 1]));
            centers.push(drawn.gather(1, best.expand([batch, 1, dim])));
        }
        Tensor::cat(centers, 1)
    }

    /// The nearest mean of every token, per scene.
    fn assign(&self, means: &Tensor<3>) -> Vec<Labels> {
        let num_tokens = self.tokens.dims()[1];
        let (distance, assignment) = self.distances(means.clone()).min_dim_with_indices(2);
        let distance: Vec<f32> = distance.into_data().convert::<f32>().try_to_vec::<f32>().expect("converted to f32");
        let assignment: Vec<i64> =
            assignment.into_data().convert::<i64>().try_to_vec::<i64>().expect("converted to i64");
        let scenes = assignment.chunks(num_tokens).zip(distance.chunks(num_tokens));
        scenes
            .map(|(assignment, distance)| Labels {
                assignment: assignment.iter().map(|&cluster| cluster as u32).collect(),
                distance: distance.to_vec(),
            })
            .collect()
    }

    /// Mean of the tokens of every cluster; none is empty.
    fn means(&self, labels: &[&Labels], num_clusters: usize) -> Tensor<3> {
        let [batch, num_tokens, dim] = self.tokens.dims();
        let device = self.device();
        let mut counts = vec![0.0_f32; batch * num_clusters];
        let mut rows = Vec::with_capacity(batch * num_tokens);
        for (scene, labels) in labels.iter().enumerate() {
            for &cluster in &labels.assignment {
                let row = scene * num_clusters + cluster as usize;
                counts[row] += 1.0;
                rows.push(row as i64);
            }
        }
        let rows = Tensor::<1, Int>::from_data(TensorData::new(rows, [batch * num_tokens]), &device);
        let counts = Tensor::<2>::from_data(TensorData::new(counts, [batch * num_clusters, 1]), &device);
        let flat = self.tokens.clone().reshape([batch * num_tokens, dim]);
        let sums = Tensor::<2>::zeros([batch * num_clusters, dim], (&device, flat.dtype()));
        let sums = sums.select_assign(0, rows, flat.clone(), IndexingUpdateOp::Add);
        (sums / counts.cast(flat.dtype())).reshape([batch, num_clusters, dim])
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;
    use crate::testing::{Fixture, devices, random, to_vec};

    fn assert_valid(fit: &Fit, num_clusters: usize) {
        for scene in fit.clusters.scenes() {
            let unique: BTreeSet<_> = scene.centroid_index().iter().collect();
            assert_eq!(unique.len(), num_clusters, "centroids are distinct tokens");
            let used: BTreeSet<_> = scene.assignment().iter().collect();
            assert_eq!(used.len(), num_clusters, "no cluster is empty");
        }
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
            assert_valid(&KMeans::default().fit(tokens, 8, &[0]).expect("fits"), 8);
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
}
