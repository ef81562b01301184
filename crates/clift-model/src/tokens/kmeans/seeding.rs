//! Initial centers of K-means: greedy k-means++ (Arthur and Vassilvitskii 2007) on a table of distances.
//!
//! Seeding is a sequence of thousands of small steps, each of which depends on the previous sample. The device therefore
//! computes only the table, in a few matrix products; the steps run on the host. A scene too large for the table of all
//! pairs first samples a pool of candidates, in the rounds of k-means|| (Bahmani et al. 2012).
// N tokens, S clusters, P tokens in the pool

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use crate::tokens::kmeans::samples::Samples;

/// Most entries of the table (256 MiB in f32), unless a pool of twice the clusters needs more.
pub(crate) const MAX_TABLE_LEN: usize = 1 << 26;
/// Rounds of sampling the pool; Bahmani et al. find no gain in more rounds.
const NUM_ROUNDS: usize = 5;
/// Fewest distances that one thread sums.
const PARALLEL_LEN: usize = 1 << 15;

/// Samples `num_clusters` initial centers; fewer if there are fewer distinct tokens.
pub(crate) fn seed(samples: &Samples, num_clusters: usize, seed: u64, max_table_len: usize) -> Vec<usize> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let pool_len = pool_len(samples.len(), num_clusters, max_table_len);
    let pool = if pool_len < samples.len() { Pool::sample(samples, pool_len, &mut rng) } else { Pool::all(samples) };
    pool.centers(num_clusters, &mut rng)
}

/// Number of candidates, each with a row of the table.
pub(crate) fn pool_len(num_tokens: usize, num_clusters: usize, max_table_len: usize) -> usize {
    (max_table_len / num_tokens).max(2 * num_clusters).min(num_tokens)
}

struct Pool {
    /// Distinct tokens, `[P]`.
    tokens: Vec<usize>,
    /// Number of tokens nearest to each candidate, `[P]`.
    weights: Vec<f64>,
    /// Squared distances of the candidates to all tokens, `[P, N]`.
    distances: Vec<f32>,
    num_tokens: usize,
}

impl Pool {
    fn all(samples: &Samples) -> Self {
        let num_tokens = samples.len();
        let tokens: Vec<usize> = (0..num_tokens).collect();
        Self { distances: samples.distances(&tokens), weights: vec![1.0; num_tokens], tokens, num_tokens }
    }

    /// Samples at most `pool_len` candidates; each round samples with probability proportional to the squared distance to
    /// the candidates of earlier rounds.
    fn sample(samples: &Samples, pool_len: usize, rng: &mut ChaCha8Rng) -> Self {
        let num_tokens = samples.len();
        let mut tokens = vec![rng.random_range(0..num_tokens)];
        let mut distances = samples.distances(&tokens);
        let mut nearest = distances.clone();
        let mut owner = vec![0; num_tokens];
        for round in 1..=NUM_ROUNDS {
            let weighted = WeightedIndices::new(nearest.iter().map(|&distance| f64::from(distance)));
            let target_len = pool_len * round / NUM_ROUNDS;
            let mut sampled: Vec<usize> = (tokens.len()..target_len).filter_map(|_| weighted.sample(rng)).collect();
            sampled.sort_unstable();
            sampled.dedup();
            let rows = samples.distances(&sampled);
            for (row, index) in rows.chunks_exact(num_tokens).zip(tokens.len()..) {
                for ((nearest, owner), &distance) in nearest.iter_mut().zip(&mut owner).zip(row) {
                    if distance < *nearest {
                        (*nearest, *owner) = (distance, index);
                    }
                }
            }
            tokens.extend(sampled);
            distances.extend(rows);
        }
        let mut weights = vec![0.0; tokens.len()];
        for index in owner {
            weights[index] += 1.0;
        }
        Self { tokens, weights, distances, num_tokens }
    }

    fn row(&self, index: usize) -> &[f32] {
        &self.distances[index * self.num_tokens..][..self.num_tokens]
    }

    /// Selects centers one by one: each step samples candidates with probability proportional to the weight times the
    /// squared distance to the centers so far, and adds the candidate with the smallest resulting inertia.
    fn centers(&self, num_clusters: usize, rng: &mut ChaCha8Rng) -> Vec<usize> {
        // Twice the samples of scikit-learn: the distances are in the table, and a better start saves iterations.
        let num_samples = 2 * (2 + (num_clusters as f64).ln() as usize);
        let Some(first) = WeightedIndices::new(self.weights.iter().copied()).sample(rng) else { return Vec::new() };
        let mut centers = vec![self.tokens[first]];
        let mut nearest = self.row(first).to_vec();
        while centers.len() < num_clusters {
            let weighted =
                WeightedIndices::new(self.tokens.iter().zip(&self.weights).map(|(&t, w)| w * f64::from(nearest[t])));
            let indices: Vec<usize> = (0..num_samples).filter_map(|_| weighted.sample(rng)).collect();
            // Threads do not pay off for few tokens.
            let min_len = PARALLEL_LEN.div_ceil(self.num_tokens);
            let sum = |&index: &usize| (sum_of_smaller(self.row(index), &nearest), index);
            let sums: Vec<(f32, usize)> = indices.par_iter().with_min_len(min_len).map(sum).collect();
            let Some(&(_, index)) = sums.iter().reduce(|best, next| if next.0 < best.0 { next } else { best }) else {
                break;
            };
            centers.push(self.tokens[index]);
            nearest.iter_mut().zip(self.row(index)).for_each(|(nearest, &distance)| *nearest = nearest.min(distance));
        }
        centers
    }
}

struct WeightedIndices {
    cumulative: Vec<f64>,
}

impl WeightedIndices {
    fn new(weights: impl Iterator<Item = f64>) -> Self {
        let cumulative = weights.scan(0.0, |sum, weight| {
            *sum += weight;
            Some(*sum)
        });
        Self { cumulative: cumulative.collect() }
    }

    /// Samples an index; `None` if all weights are zero.
    fn sample(&self, rng: &mut ChaCha8Rng) -> Option<usize> {
        let total = self.cumulative.last().copied().filter(|&total| total > 0.0)?;
        let threshold = rng.random_range(0.0..1.0_f64) * total;
        let index = self.cumulative.partition_point(|&sum| sum <= threshold);
        Some(index.min(self.cumulative.len() - 1))
    }
}

/// Returns the sum of `min(a[i], b[i])`. Sixteen partial sums let the compiler use vector registers.
fn sum_of_smaller(a: &[f32], b: &[f32]) -> f32 {
    let smaller = |a: f32, b: f32| if a < b { a } else { b };
    let ((a, a_rest), (b, b_rest)) = (a.as_chunks::<16>(), b.as_chunks::<16>());
    let mut sums = [0.0_f32; 16];
    for (a, b) in a.iter().zip(b) {
        for lane in 0..16 {
            sums[lane] += smaller(a[lane], b[lane]);
        }
    }
    let rest: f32 = a_rest.iter().zip(b_rest).map(|(&a, &b)| smaller(a, b)).sum();
    sums.iter().sum::<f32>() + rest
}

#[cfg(test)]
mod tests {
    use burn::tensor::{DType, Device, Tensor};

    use super::*;
    use crate::testing::{devices, random};

    fn samples(tokens: &Tensor<2>) -> Samples {
        Samples::new(tokens.clone()).expect("finite")
    }

    /// Returns tokens around 40 points, `[400, 5]`.
    fn clustered(device: &Device) -> Tensor<2> {
        let points = random([40, 5], 21, device).cast(DType::F32) * 4.0;
        points.repeat_dim(0, 10) + random([400, 5], 22, device).cast(DType::F32) * 0.3
    }

    /// Returns the sum of squared distances to the nearest center.
    fn potential(samples: &Samples, centers: &[usize]) -> f64 {
        let rows = samples.distances(centers);
        let nearest = |token| rows[token..].iter().step_by(samples.len()).copied().fold(f32::INFINITY, f32::min);
        (0..samples.len()).map(|token| f64::from(nearest(token))).sum()
    }

    #[test]
    fn centers_are_distinct_and_better_than_random() {
        for device in devices() {
            let samples = samples(&clustered(&device));
            // The table of all pairs, and pools of 160 and 80 of 400 tokens.
            for max_table_len in [MAX_TABLE_LEN, 160 * 400, 0] {
                let mut sums = [0.0; 2];
                for start in 0..10 {
                    let mut centers = seed(&samples, 40, start, max_table_len);
                    sums[0] += potential(&samples, &centers);
                    centers.sort_unstable();
                    centers.dedup();
                    assert_eq!(centers.len(), 40);
                    let mut rng = ChaCha8Rng::seed_from_u64(start);
                    let random: Vec<usize> = (0..40).map(|_| rng.random_range(0..400)).collect();
                    sums[1] += potential(&samples, &random);
                }
                assert!(sums[0] < 0.2 * sums[1], "table of {max_table_len}: {} against {}", sums[0], sums[1]);
            }
        }
    }

    #[test]
    fn a_pool_has_distinct_tokens_and_weights_of_all() {
        let device = Device::flex();
        let samples = samples(&clustered(&device));
        let pool = Pool::sample(&samples, 100, &mut ChaCha8Rng::seed_from_u64(3));
        let mut tokens = pool.tokens.clone();
        tokens.sort_unstable();
        tokens.dedup();
        assert_eq!(tokens.len(), pool.tokens.len());
        assert!((80..=100).contains(&tokens.len()), "{} tokens", tokens.len());
        assert_eq!(pool.distances, samples.distances(&pool.tokens));
        let nearest_to = |token: usize| {
            let distance = |&index: &usize| pool.row(index)[token];
            (0..pool.tokens.len()).min_by(|a, b| distance(a).total_cmp(&distance(b))).expect("a pool is not empty")
        };
        let mut weights = vec![0.0; pool.tokens.len()];
        (0..400).for_each(|token| weights[nearest_to(token)] += 1.0);
        assert_eq!(pool.weights, weights);
    }
}
