//! Tokens with the transforms of camera-relative attention.

use burn::tensor::{Int, Tensor};

use crate::network::camera_encoding::{TokenTransforms, upload_ids};
use crate::tokens::clusters::ClusterIndex;

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

    /// Returns `[batch, num_tokens, dim]`.
    pub fn dims(&self) -> [usize; 3] {
        self.values.dims()
    }

    /// Returns other values of the same tokens.
    #[must_use]
    pub fn with_values(&self, values: Tensor<3>) -> Self {
        Self { transforms: self.transforms.as_ref().map(|transforms| transforms.tracked_as(&values)), values }
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
