//! The row of latent K-means, on the tokens of the seeded encoder.

use burn::tensor::{Device, Tensor};
use clift_model::{KMeans, KMeansFit, ModelError};
use clift_train::TrainError;

use crate::cases::context::BenchContext;
use crate::cases::reference::ToF64;
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
        let (reached, expected) = (fit.inertia[0], self.fit(self.tokens.in_f64(reference))?.inertia[0]);
        Ok(if reached == expected { 0.0 } else { (reached - expected).abs() / expected })
    }
}
