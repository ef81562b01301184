//! The row of latent K-means, on the tokens of the seeded encoder or on features of a file.
// N tokens, D width

use std::path::Path;

use burn::tensor::{Device, Tensor, TensorData};
use clift_model::{KMeans, KMeansFit, ModelError};
use clift_train::TrainError;
use safetensors::{Dtype, SafeTensors};

use crate::cases::context::BenchContext;
use crate::cases::reference::{ToF64, values};
use crate::cases::task::BenchTask;

const FEATURES: &str = "features";

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
        let tokens = match &context.features {
            Some(path) => read_features(path, &context.device)?,
            None => context.lift()?.values,
        };
        let num_clusters = context.stored_of(tokens.dims()[1])?;
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

    fn error(self: Box<Self>, reference: &Device) -> Result<Option<f64>, TrainError> {
        let fit = match &self.fit {
            Some(fit) => fit.clone(),
            None => self.fit(self.tokens.clone())?,
        };
        let reached = inertia(&self.tokens, &fit);
        let tokens = self.tokens.in_f64(reference);
        let expected = inertia(&self.tokens, &self.fit(tokens)?);
        Ok(Some(if reached == expected { 0.0 } else { (reached - expected).abs() / expected }))
    }

    fn inertia(&self) -> Option<f64> {
        self.fit.as_ref().map(|fit| inertia(&self.tokens, fit))
    }
}

/// Returns the sum of squared distances of the tokens to the mean of their cluster in f64: `inertia_` of scikit-learn.
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

/// Reads the tensor `features`, `[N, D]` in f32, of a safetensors file as one scene, `[1, N, D]`.
fn read_features(path: &Path, device: &Device) -> Result<Tensor<3>, TrainError> {
    let bad = |reason: String| TrainError::bad_file("features", path)(reason);
    let bytes = std::fs::read(path).map_err(TrainError::io("reading the features", path))?;
    let file = SafeTensors::deserialize(&bytes).map_err(|error| bad(error.to_string()))?;
    let view = file.tensor(FEATURES).map_err(|error| bad(error.to_string()))?;
    let (dtype, shape) = (view.dtype(), view.shape());
    let (Dtype::F32, &[num_tokens, dim]) = (dtype, shape) else {
        return Err(bad(format!("`{FEATURES}` is {dtype:?} of shape {shape:?}, expected F32 of [tokens, width]")));
    };
    if num_tokens == 0 || dim == 0 {
        return Err(bad(format!("`{FEATURES}` has the shape {shape:?}")));
    }
    let values: Vec<f32> = view.data().as_chunks::<4>().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect();
    Ok(Tensor::from_data(TensorData::new(values, [1, num_tokens, dim]), device))
}

#[cfg(test)]
mod tests {
    use clift_model::{Clusters, SceneClusters};
    use safetensors::tensor::TensorView;

    use super::*;

    #[test]
    fn inertia_is_measured_from_cluster_means() {
        let tokens = Tensor::<3>::from_floats([[[0.0, 0.0], [2.0, 0.0], [10.0, 1.0], [10.0, 4.0]]], &Device::flex());
        let scene = SceneClusters::new(vec![0, 0, 1, 1], vec![0, 2]).expect("valid");
        let fit = KMeansFit { clusters: Clusters::new(vec![scene]).expect("one"), inertia: vec![0.0], iterations: 0 };
        assert_eq!(inertia(&tokens, &fit), 1.0 + 1.0 + 2.25 + 2.25);
    }

    #[test]
    fn features_are_read_and_other_tensors_refused() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("features.safetensors");
        let write = |name: &str, shape: Vec<usize>| {
            let bytes: Vec<u8> = (0_u8..6).flat_map(|value| f32::from(value).to_le_bytes()).collect();
            let view = TensorView::new(Dtype::F32, shape, &bytes).expect("fits");
            safetensors::serialize_to_file([(name, view)], None, &path).expect("writable");
            read_features(&path, &Device::flex())
        };
        let read = write(FEATURES, vec![3, 2]).expect("valid");
        assert_eq!(read.dims(), [1, 3, 2]);
        assert_eq!(values(read), [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]);
        let message = write(FEATURES, vec![6]).unwrap_err().to_string();
        assert!(message.contains("`features` is F32 of shape [6], expected F32 of [tokens, width]"), "{message}");
        assert!(write("other", vec![3, 2]).unwrap_err().to_string().contains("features"));
        std::fs::write(&path, b"no").expect("writable");
        assert!(read_features(&path, &Device::flex()).is_err());
    }
}
