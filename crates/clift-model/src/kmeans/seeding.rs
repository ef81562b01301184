//! Where K-means starts: greedy k-means++ (Arthur and Vassilvitskii 2007) that reads a table of distances.
//!
//! A start is thousands of small steps one after another, each a draw that depends on the one before. The
//! device therefore only computes the table, in a few matrix products; the steps read it on the host, where
//! many draws per step cost little. A scene too large for the table of all pairs first draws a pool of
//! tokens that may become centers, with the rounds of k-means|| (Bahmani et al. 2012).
// N tokens, S clusters, P tokens in the pool

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::samples::Samples;

/// Most entries of the table, unless twice the clusters need more (256 MiB in f32).
pub(super) const MAX_TABLE_LEN: usize = 1 << 26;

/// Rounds that draw the pool; Bahmani et al. find no gain in more.
const NUM_ROUNDS: usize = 5;

/// Draws `num_clusters` tokens to start from, fewer when there are not as many different ones.
pub(super) fn seed(samples: &Samples, num_clusters: usize, seed: u64, max_table_len: usize) -> Vec<usize> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let pool_len = (max_table_len / samples.len()).max(2 * num_clusters);
    let pool = if pool_len < samples.len() { Pool::draw(samples, pool_len, &mut rng) } else { Pool::all(samples) };
    pool.centers(num_clusters, &mut rng)
}

/// The tokens that may become centers.
struct Pool {
    /// `[P]`, each once.
    tokens: Vec<usize>,
    /// How many tokens each stands for, `[P]`.
    weights: Vec<f64>,
    /// Squared distances to all tokens, `[P, N]`.
    distances: Vec<f32>,
    num_tokens: usize,
}

impl Pool {
    fn all(samples: &Samples) -> Self {
        let num_tokens = samples.len();
        let tokens: Vec<usize> = (0..num_tokens).collect();
        Self { distances: samples.distances(&tokens), weights: vec![1.0; num_tokens], tokens, num_tokens }
    }

    /// At most `pool_len` tokens, far from each other: each round draws with probability proportional to
    /// the squared distance to the tokens of the rounds before.
    fn draw(samples: &Samples, pool_len: usize, rng: &mut ChaCha8Rng) -> Self {
        let num_tokens = samples.len();
        let mut tokens = vec![rng.random_range(0..num_tokens)];
        let mut distances = samples.distances(&tokens);
        let mut nearest = distances.clone();
        let mut owner = vec![0; num_tokens];
        for round in 1..=NUM_ROUNDS {
            let draws = Draws::new(nearest.iter().map(|&distance| f64::from(distance)));
            let wanted = pool_len * round / NUM_ROUNDS;
            let mut drawn: Vec<usize> = (tokens.len()..wanted).filter_map(|_| draws.draw(rng)).collect();
            drawn.sort_unstable();
            drawn.dedup();
            let rows = samples.distances(&drawn);
            for (row, place) in rows.chunks_exact(num_tokens).zip(tokens.len()..) {
                for ((nearest, owner), &distance) in nearest.iter_mut().zip(&mut owner).zip(row) {
                    if distance < *nearest {
                        (*nearest, *owner) = (distance, place);
                    }
                }
            }
            tokens.extend(drawn);
            distances.extend(rows);
        }
        let mut weights = vec![0.0; tokens.len()];
        owner.into_iter().for_each(|place| weights[place] += 1.0);
        Self { tokens, weights, distances, num_tokens }
    }

    fn row(&self, place: usize) -> &[f32] {
        &self.distances[place * self.num_tokens..][..self.num_tokens]
    }

    /// Each step draws tokens of the pool with probability proportional to weight and squared distance to
    /// the centers so far, and keeps the one that lowers the sum of all tokens' squared distances the most.
    fn centers(&self, num_clusters: usize, rng: &mut ChaCha8Rng) -> Vec<usize> {
        // Four times as many as scikit-learn draws: the distances are there already, and the better start
        // saves an iteration, which costs more.
        let num_draws = 4 * (2 + (num_clusters as f64).ln() as usize);
        let Some(first) = Draws::new(self.weights.iter().copied()).draw(rng) else { return Vec::new() };
        let mut centers = vec![self.tokens[first]];
        let mut nearest = self.row(first).to_vec();
        while centers.len() < num_clusters {
            let draws = Draws::new(self.tokens.iter().zip(&self.weights).map(|(&t, w)| w * f64::from(nearest[t])));
            let mut best: Option<(f32, usize)> = None;
            for place in (0..num_draws).filter_map(|_| draws.draw(rng)) {
                let sum = sum_of_smaller(self.row(place), &nearest);
                if best.is_none_or(|(least, _)| sum < least) {
                    best = Some((sum, place));
                }
            }
            let Some((_, place)) = best else { break };
            centers.push(self.tokens[place]);
            nearest.iter_mut().zip(self.row(place)).for_each(|(nearest, &distance)| *nearest = nearest.min(distance));
        }
        centers
    }
}

/// Draws places with probability proportional to their weights.
struct Draws {
    cumulative: Vec<f64>,
}

impl Draws {
    fn new(weights: impl Iterator<Item = f64>) -> Self {
        let cumulative = weights.scan(0.0, |sum, weight| {
            *sum += weight;
            Some(*sum)
        });
        Self { cumulative: cumulative.collect() }
    }

    /// `None` when all weights are zero.
    fn draw(&self, rng: &mut ChaCha8Rng) -> Option<usize> {
        let total = self.cumulative.last().copied().filter(|&total| total > 0.0)?;
        let threshold = rng.random_range(0.0..1.0_f64) * total;
        let place = self.cumulative.partition_point(|&sum| sum <= threshold);
        Some(place.min(self.cumulative.len() - 1))
    }
}

/// Sum over all places of the smaller of two values. Sixteen sums side by side, because the compiler may
/// not reorder a single one to use vector registers.
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
