//! The tokens of one scene: distances and means, on the device.

use burn::tensor::{DType, IndexingUpdateOp, Tensor, TensorData, Transaction};
use rayon::prelude::*;

use crate::ops::matmul::matmul_without_gradient;
use crate::tokens::kmeans::labels::Labels;

/// Distances per matrix product for the table on the host: 4 MiB in f32, which fit into a cache.
const BLOCK_LEN: usize = 1 << 20;

pub(crate) struct Samples {
    /// Tokens minus their mean, `[N, D]`.
    tokens: Tensor<2>,
    /// Squared lengths, `[N]`.
    squares: Vec<f64>,
}

impl Samples {
    /// Centers the tokens of a scene, `[N, D]`; `None` if a squared length is not finite in f32.
    pub fn new(tokens: Tensor<2>) -> Option<Self> {
        // Distances are differences of squares, most accurate for centered tokens.
        let tokens = tokens.clone() - tokens.mean_dim(0);
        let squares = floats(tokens.clone().square().sum_dim(1).into_data());
        squares.iter().all(|&square| (square as f32).is_finite()).then_some(Self { tokens, squares })
    }

    pub fn len(&self) -> usize {
        self.squares.len()
    }

    /// Selects tokens, `[ids.len(), D]`.
    pub fn select(&self, ids: &[usize]) -> Tensor<2> {
        self.tokens.clone().select(0, Tensor::from_data(ids, &self.tokens.device()))
    }

    /// Computes the squared distances `|x|^2 - 2 x y + |y|^2` of some tokens to all, on the host: `[ids.len(), N]`.
    pub fn distances(&self, ids: &[usize]) -> Vec<f32> {
        let squares: Vec<f32> = self.squares.iter().map(|&square| square as f32).collect();
        let (count, rows) = (self.len(), (BLOCK_LEN / self.len()).max(1));
        let mut distances = vec![0.0; ids.len() * count];
        for (ids, distances) in ids.chunks(rows).zip(distances.chunks_mut(rows * count)) {
            let products = matmul_without_gradient(self.select(ids), self.tokens.clone().transpose());
            let products = products.cast(DType::F32).into_data();
            let products = products.as_slice::<f32>().expect("cast to f32");
            let lines = distances.par_chunks_mut(count).zip(products.par_chunks(count)).zip(ids);
            lines.for_each(|((distances, products), &id)| {
                let own = squares[id];
                for ((distance, product), square) in distances.iter_mut().zip(products).zip(&squares) {
                    *distance = ((own + square) - 2.0 * product).max(0.0);
                }
                distances[id] = 0.0;
            });
        }
        distances
    }

    /// Assigns every token to the nearest mean, ties to the lower index, with one transfer from the device.
    pub fn assign(&self, means: Tensor<2>) -> Labels {
        let squares = means.clone().square().sum_dim(1).transpose(); // [1, S]
        // The square of the token is equal for all means and added on the host.
        let scores = matmul_without_gradient(self.tokens.clone(), means.mul_scalar(-2.0).transpose()) + squares; // [N, S]
        let (score, cluster) = scores.min_dim_with_indices(1);
        let mut read = Transaction::default().register(score).register(cluster).execute().into_iter();
        let mut next = || read.next().expect("two were registered");
        let distance =
            floats(next()).iter().zip(&self.squares).map(|(score, square)| (score + square).max(0.0)).collect();
        let assignment = next().try_into_vec_as::<u32>().expect("an index is not negative");
        Labels { assignment, distance }
    }

    /// Computes the mean of every cluster, `[S, D]`; no cluster may be empty.
    pub fn means(&self, labels: &Labels, num_clusters: usize) -> Tensor<2> {
        let mut counts = vec![0.0_f64; num_clusters];
        labels.assignment.iter().for_each(|&cluster| counts[cluster as usize] += 1.0);
        let like = (&self.tokens.device(), self.tokens.dtype());
        let counts = Tensor::<2>::from_data(TensorData::new(counts, [num_clusters, 1]), like);
        let rows: Vec<i64> = labels.assignment.iter().map(|&cluster| i64::from(cluster)).collect();
        let rows = Tensor::from_data(rows.as_slice(), like.0);
        let sums = Tensor::<2>::zeros([num_clusters, self.tokens.dims()[1]], like);
        sums.select_assign(0, rows, self.tokens.clone(), IndexingUpdateOp::Add) / counts
    }
}

fn floats(data: TensorData) -> Vec<f64> {
    data.try_into_vec_as().expect("converts to f64")
}
