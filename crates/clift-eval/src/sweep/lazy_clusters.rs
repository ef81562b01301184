//! Clusters or tiles of a scene's tokens, computed for the first method that needs them.

use std::cell::OnceCell;

use burn::tensor::Tensor;
use clift_model::{Clusters, KMeans, tile_clusters};

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
    clusters: OnceCell<Clusters>,
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
        Self { kmeans, lift, num_clusters, seed, views, clusters: OnceCell::new(), tiles: OnceCell::new() }
    }

    pub fn tiles(&self) -> Result<&Clusters, EvalError> {
        computed_once(&self.tiles, || {
            let (num_views, grid) = self.views;
            Ok(Clusters::new(vec![tile_clusters(num_views, grid, self.num_clusters)?])?)
        })
    }

    pub fn clusters(&self) -> Result<&Clusters, EvalError> {
        computed_once(&self.clusters, || {
            Ok(self.kmeans.fit(self.lift.clone(), self.num_clusters, &[self.seed])?.clusters)
        })
    }
}

fn computed_once(
    cell: &OnceCell<Clusters>,
    compute: impl FnOnce() -> Result<Clusters, EvalError>,
) -> Result<&Clusters, EvalError> {
    if let Some(clusters) = cell.get() {
        return Ok(clusters);
    }
    let clusters = compute()?;
    Ok(cell.get_or_init(|| clusters))
}
