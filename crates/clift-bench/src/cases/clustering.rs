//! The row of latent K-means, on the tokens of the seeded encoder.

use burn::tensor::{Device, Tensor};
use clift_model::{KMeans, KMeansFit, ModelError};
use clift_train::TrainError;

use crate::cases::context::BenchContext;
use crate::cases::reference::{ToF64, values};
use crate::cases::task::BenchTask;

/// K-means of one scene's tokens, from the same seed in every repetition.
pub struct KMeansCase {
    kmeans: KMeans,
    tokens: Tensor<3>,
    num_clusters: usize,
    seed: u64,
    fit: Option<KMeansFit>,
}

impl KMeansCase {
    pub fn new(context: &BenchContext) -> Result<Self, TrainError> {
        let tokens = context.lift()?.values;
        let num_clusters = context.num_storage_tokens()?;
        let kmeans = context.config.clusters.kmeans.clone();
        Ok(Self { kmeans, tokens, num_clusters, seed: context.config.seed, fit: None })
    }

    fn fit(&self, tokens: Tensor<3>) -> Result<KMeansFit, ModelError> {
        self.kmeans.fit(tokens, self.num_clusters, &[self.seed])
    }
}

impl BenchTask for KMeansCase {
    fn run(&mut self) -> Result<(), TrainError> {
        self.fit = Some(self.fit(self.tokens.clone())?);
        Ok(())
    }

    fn error(self: Box<Self>, reference: &Device) -> Result<f64, TrainError> {
        let fit = match &self.fit {
            Some(fit) => fit.clone(),
            None => self.fit(self.tokens.clone())?,
        };
        let reached = inertia(&self.tokens, &fit);
        let tokens = self.tokens.in_f64(reference);
        let expected = inertia(&self.tokens, &self.fit(tokens)?);
        Ok(if reached == expected { 0.0 } else { (reached - expected).abs() / expected })
    }
}

/// Returns the sum of squared distances of the tokens to the mean of their cluster in f64.
/// [`KMeansFit::inertia`] uses the means of the iteration before, in the device's floats.
fn inertia(tokens: &Tensor<3>, fit: &KMeansFit) -> f64 {
    let dim = tokens.dims()[2];
    let tokens = values(tokens.clone());
    let scene = &fit.clusters.scenes()[0];
    let mut sums = vec![0.0; scene.centroid_index().len() * dim];
    let mut counts = vec![0.0; scene.centroid_index().len()];
    for (token, &cluster) in tokens.chunks(dim).zip(scene.assignment()) {
        let cluster = cluster as usize;
        counts[cluster] += 1.0;
        sums[cluster * dim..][..dim].iter_mut().zip(token).for_each(|(sum, value)| *sum += value);
    }
    let distances = tokens.chunks(dim).zip(scene.assignment()).map(|(token, &cluster)| {
        let (sum, count) = (&sums[cluster as usize * dim..][..dim], counts[cluster as usize]);
        token.iter().zip(sum).map(|(value, sum): (&f64, &f64)| (value - sum / count).powi(2)).sum::<f64>()
    });
    distances.sum()
}

#[cfg(test)]
mod tests {
    use clift_model::{Clusters, SceneClusters};

    use super::*;

    #[test]
    fn inertia_is_measured_from_cluster_means() {
        let tokens = Tensor::<3>::from_floats([[[0.0, 0.0], [2.0, 0.0], [10.0, 1.0], [10.0, 4.0]]], &Device::flex());
        let scene = SceneClusters::new(vec![0, 0, 1, 1], vec![0, 2]).expect("valid");
        let fit = KMeansFit { clusters: Clusters::new(vec![scene]).expect("one"), inertia: vec![0.0] };
        assert_eq!(inertia(&tokens, &fit), 1.0 + 1.0 + 2.25 + 2.25);
    }
}
