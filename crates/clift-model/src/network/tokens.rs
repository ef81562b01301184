//! Tokens with the transforms of camera-relative attention.

use burn::tensor::{Int, Tensor, TensorData};

use crate::error::ModelError;
use crate::network::camera_encoding::transforms;
use crate::network::config::ModelConfig;
use crate::tokens::clusters::ClusterIndex;
use crate::views::upload::Cameras;

/// Tokens of scenes. Through clustering, storage and selection they keep the camera and the patch that they come from.
#[derive(Clone, Debug)]
pub struct Tokens {
    /// Values, `[batch, num_tokens, dim]`.
    pub values: Tensor<3>,
    /// Transform of every token, `[batch, num_tokens, L]`; `None` without camera-relative attention.
    pub transforms: Option<Tensor<3>>,
}

impl Tokens {
    /// Takes the tokens of a network without camera-relative attention.
    pub fn without_cameras(values: Tensor<3>) -> Self {
        Self { values, transforms: None }
    }

    /// Takes stored tokens, one of every patch of the context views in `ids`.
    pub fn of_patches(config: &ModelConfig, values: Tensor<3>, context: &Cameras, ids: &[u32]) -> Self {
        Self { values, transforms: transforms(config, context).map(|transforms| select(transforms, ids)) }
    }

    /// Returns `[batch, num_tokens, dim]`.
    pub fn dims(&self) -> [usize; 3] {
        self.values.dims()
    }

    /// Returns other values of the same tokens.
    #[must_use]
    pub fn with_values(&self, values: Tensor<3>) -> Self {
        Self { transforms: self.transforms.as_ref().map(|transforms| tracked_as(transforms, &values)), values }
    }

    /// Returns values and transforms with other rows.
    #[must_use]
    pub(crate) fn map(&self, rows: impl Fn(Tensor<3>) -> Tensor<3>) -> Self {
        Self { values: rows(self.values.clone()), transforms: self.transforms.clone().map(rows) }
    }

    /// Returns the values on the host, row-major.
    pub fn to_host(&self) -> Result<Vec<f32>, ModelError> {
        self.values.clone().into_data().convert::<f32>().try_to_vec().map_err(ModelError::device)
    }

    /// Returns other values of the same tokens, from the host, row-major.
    #[must_use]
    pub fn with_host_values(&self, values: Vec<f32>) -> Self {
        self.with_values(Tensor::from_data(TensorData::new(values, self.dims()), &self.values.device()))
    }

    /// Selects the same tokens of every scene, given by their indices.
    #[must_use]
    pub fn select(&self, ids: &[u32]) -> Self {
        self.map(|rows| select(rows, ids))
    }

    /// Selects the centroids of clusters, `[batch, num_storage_tokens, dim]`.
    #[must_use]
    pub fn centroids(&self, clusters: &ClusterIndex) -> Self {
        self.map(|rows| clusters.gather(rows, &clusters.centroid))
    }
}

/// Selects the same rows of every scene, given by their indices.
pub(crate) fn select(rows: Tensor<3>, ids: &[u32]) -> Tensor<3> {
    let ids: Vec<i64> = ids.iter().map(|&id| i64::from(id)).collect();
    let ids = Tensor::<1, Int>::from_data(ids.as_slice(), &rows.device());
    rows.select(1, ids)
}

/// Returns transforms with autodiff if `other` has it, or without.
pub(crate) fn tracked_as(transforms: &Tensor<3>, other: &Tensor<3>) -> Tensor<3> {
    match (transforms.is_autodiff(), other.is_autodiff()) {
        (false, true) => transforms.clone().autodiff(),
        (true, false) => transforms.clone().inner(),
        _ => transforms.clone(),
    }
}
