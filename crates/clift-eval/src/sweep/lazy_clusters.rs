//! Clusters or tiles of a scene's tokens, computed once, for the first method that needs them.

use std::cell::OnceCell;

use burn::tensor::Tensor;
use clift_model::{Clusters, KMeans, KMeansFit, SceneClusters, tile_clusters};

use crate::error::EvalError;

/// Groups of one count, made when the first variant asks.
pub(crate) struct LazyClusters<'a> {
    pub kmeans: &'a KMeans,
    /// Tokens that are clustered, `[1, N, D]`.
    pub lift: &'a Tensor<3>,
    pub num_clusters: usize,
    pub seed: u64,
    /// Context views, and rows and columns of tokens of each.
    pub views: (usize, [usize; 2]),
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

    /// Tiles of the context views, [`tile_clusters`].
    pub fn tiles(&self) -> Result<&Clusters, EvalError> {
        if let Some(tiles) = self.tiles.get() {
            return Ok(tiles);
        }
        let (num_views, grid) = self.views;
        let tiles = Clusters::new(vec![tile_clusters(num_views, grid, self.num_clusters)?])?;
        Ok(self.tiles.get_or_init(|| tiles))
    }

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

    /// Those of the one scene there is.
    pub fn scene_clusters(&self) -> Result<&SceneClusters, EvalError> {
        Ok(&self.clusters()?.scenes()[0])
    }
}
