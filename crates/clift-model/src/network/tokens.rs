//! Tokens with the transforms of camera-relative attention.

use burn::tensor::{Int, Tensor, TensorData};

use crate::error::ModelError;
use crate::network::camera_encoding::{TokenTransforms, TransformMaker, upload_ids};
use crate::network::config::ModelConfig;
use crate::tokens::clusters::ClusterIndex;
use crate::views::upload::Cameras;

/// Tokens of scenes. Through clustering, storage and selection they keep the camera and the patch that they come from.
#[derive(Clone, Debug)]
pub struct Tokens {
    /// Values, `[batch, num_tokens, dim]`.
    pub values: Tensor<3>,
    /// Transform of every token; `None` without camera-relative attention.
    pub transforms: Option<TokenTransforms>,
}

impl Tokens {
    /// Takes the tokens of a network without camera-relative attention.
    ///
    /// # Shapes
    /// - `values`: `[batch, num_tokens, dim]`
    pub fn without_cameras(values: Tensor<3>) -> Self {
        Self { values, transforms: None }
    }

    /// Takes stored tokens, one of every patch of the context views in `ids`.
    ///
    /// # Shapes
    /// - `values`: `[batch, num_tokens, dim]`
    /// - `context`: `[batch, views]`
    pub fn of_patches(config: &ModelConfig, values: Tensor<3>, context: &Cameras, ids: &[u32]) -> Self {
        let transforms = TransformMaker::new(config).of_views(context);
        Self { values, transforms: transforms.map(|transforms| transforms.select(ids)) }
    }

    /// Returns `[batch, num_tokens, dim]`.
    pub fn dims(&self) -> [usize; 3] {
        self.values.dims()
    }

    /// Returns other values of the same tokens.
    #[must_use]
    pub fn with_values(&self, values: Tensor<3>) -> Self {
        Self { transforms: self.transforms.as_ref().map(|transforms| transforms.tracked_as(&values)), values }
    }

    /// Joins the groups of every scene.
    ///
    /// # Shapes
    /// - of `[batch * groups, count, dim]`; returns `[batch, groups * count, dim]`
    #[must_use]
    pub(crate) fn joined(self, batch: usize) -> Self {
        let [groups, count, dim] = self.dims();
        Self {
            transforms: self.transforms.map(|transforms| transforms.regroup(batch)),
            values: self.values.reshape([batch, groups * count / batch, dim]),
        }
    }

    /// Returns the values on the host, row-major.
    ///
    /// # Errors
    /// [`ModelError::Device`].
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
        Self {
            transforms: self.transforms.as_ref().map(|transforms| transforms.select(ids)),
            values: self.values.clone().select(1, upload_ids(ids, &self.values.device())),
        }
    }

    /// Selects the centroids of clusters, `[batch, num_storage_tokens, dim]`.
    #[must_use]
    pub fn centroids(&self, clusters: &ClusterIndex) -> Self {
        self.gather(clusters, &clusters.centroid)
    }

    /// Selects rows of the tokens of all scenes.
    pub(crate) fn gather(&self, clusters: &ClusterIndex, rows: &Tensor<1, Int>) -> Self {
        let gathered = |transforms: &TokenTransforms| transforms.gather(rows.clone(), clusters.batch);
        Self { transforms: self.transforms.as_ref().map(gathered), values: clusters.gather(self.values.clone(), rows) }
    }
}
