//! The groupings of a scene's tokens: the groups that the condenser condenses, and their centroids.
// N tokens, D width

use burn::tensor::Tensor;
use serde::{Deserialize, Serialize};
use strum::{EnumCount, IntoStaticStr};

use crate::error::ModelError;
use crate::tokens::clusters::SceneClusters;
use crate::tokens::kmeans::fit::KMeans;
use crate::tokens::tiles::tile_clusters;

/// Grouping of the tokens of a scene.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, EnumCount, IntoStaticStr)]
#[serde(rename_all = "snake_case")]
#[strum(serialize_all = "snake_case")]
pub enum Grouping {
    /// Latent K-means, the method of the paper.
    #[default]
    Kmeans,
    /// Tiles of every view, the baseline of the paper.
    Tile,
}

impl Grouping {
    /// Whether the groups follow from the values of the tokens, not from their positions alone.
    pub const fn reads_tokens(self) -> bool {
        match self {
            Self::Kmeans => true,
            Self::Tile => false,
        }
    }

    /// Groups the tokens of `num_views` views of `grid` rows and columns of patches into `count` groups.
    ///
    /// `tokens` computes the encoder tokens `[1, N, D]`, if the grouping [reads](Self::reads_tokens) them.
    pub fn group(
        self,
        count: usize,
        (num_views, grid): (usize, [usize; 2]),
        (kmeans, seed): (&KMeans, u64),
        tokens: impl FnOnce() -> Tensor<3>,
    ) -> Result<SceneClusters, ModelError> {
        Ok(match self {
            Self::Kmeans => kmeans.fit(tokens(), count, &[seed])?.clusters.scenes()[0].clone(),
            Self::Tile => tile_clusters(num_views, grid, count)?,
        })
    }
}
