//! Clusters or tiles of a scene's tokens, computed for the first method that needs them.

use std::cell::OnceCell;

use burn::tensor::Tensor;
use clift_model::{Clusters, KMeans, KMeansFit, SceneClusters, tile_clusters};

use crate::error::EvalError;

/// Clusters and tiles of one count, each computed on first use.
pub(crate) struct LazyClusters<'a> {
    kmeans: &'a KMeans,
    /// The clustered tokens, `[1, N, D]`.
    lift: &'a Tensor<3>,
    pub num_clusters: usize,
    pub seed: u64,
    /// Number of context views, and rows and columns of patches of a view.
    views: (usize, [usize; 2]),
    fit: OnceCell<KMeansFit>,
    tiles: OnceCell<Clusters>,
}

impl<'a> LazyClusters<'a> {
    pub fn new(
        kmeans: &'a KMeans,
        lift: &'a Tensor<3>,
        views: (usize, [usize; 2]),
        num_clusters: usize,
        seed: u64,
    ) -> Self {
        Self { kmeans, lift, num_clusters, seed, views, fit: OnceCell::new(), tiles: OnceCell::new() }
    }

    /// Returns the tiles of the context views, see [`tile_clusters`].
    pub fn tiles(&self) -> Result<&Clusters, EvalError> {
        if let Some(tiles) = self.tiles.get() {
            return Ok(tiles);
        }
        let (num_views, grid) = self.views;
        let tiles = Clusters::new(vec![tile_clusters(num_views, grid, self.num_clusters)?])?;
        Ok(self.tiles.get_or_init(|| tiles))
    }

    /// Returns the clusters of latent K-means.
    pub fn clusters(&self) -> Result<&Clusters, EvalError> {
        Ok(&self.fit()?.clusters)
    }

    fn fit(&self) -> Result<&KMeansFit, EvalError> {
        if let Some(fit) = self.fit.get() {
            return Ok(fit);
        }
        let fit = self.kmeans.fit(self.lift.clone(), self.num_clusters, &[self.seed])?;
        Ok(self.fit.get_or_init(|| fit))
    }

    /// Returns the clusters of the scene.
    pub fn scene_clusters(&self) -> Result<&SceneClusters, EvalError> {
        Ok(&self.clusters()?.scenes()[0])
    }
}
