//! Groups of a scene's tokens, computed for the first method that needs them.

use std::cell::OnceCell;

use burn::tensor::Tensor;
use clift_model::{Clusters, Grouping, KMeans};
use strum::EnumCount;

use crate::error::EvalError;

/// The groups of one count, by every grouping, each computed on first use.
pub(crate) struct LazyClusters<'a> {
    kmeans: &'a KMeans,
    /// The grouped tokens, `[1, N, D]`.
    lift: &'a Tensor<3>,
    pub num_clusters: usize,
    pub seed: u64,
    /// Number of context views, and rows and columns of patches of a view.
    views: (usize, [usize; 2]),
    groups: [OnceCell<Clusters>; Grouping::COUNT],
}

impl<'a> LazyClusters<'a> {
    pub fn new(
        kmeans: &'a KMeans,
        lift: &'a Tensor<3>,
        views: (usize, [usize; 2]),
        num_clusters: usize,
        seed: u64,
    ) -> Self {
        Self { kmeans, lift, num_clusters, seed, views, groups: Default::default() }
    }

    pub fn groups(&self, grouping: Grouping) -> Result<&Clusters, EvalError> {
        let cell = &self.groups[grouping as usize];
        if let Some(groups) = cell.get() {
            return Ok(groups);
        }
        let tokens = || self.lift.clone();
        let groups = grouping.group(self.num_clusters, self.views, (self.kmeans, self.seed), tokens)?;
        let groups = Clusters::new(vec![groups])?;
        Ok(cell.get_or_init(|| groups))
    }
}
