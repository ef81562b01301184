//! The tokens a scene is stored with, by variant, and the renderer that draws them.
// N encoder tokens, S stored tokens, R rendered tokens, D width

use std::cell::OnceCell;

use burn::tensor::{Int, Tensor, TensorData};
use clift_data::order::item_rng;
use clift_model::kmeans::Fit;
use clift_model::{Clusters, KMeans, Renderer, SceneClusters, TokenStorage, tile_clusters};
use rand::seq::SliceRandom;

use crate::EvalError;
use crate::evaluate::Networks;
use crate::method::Variant;

/// Stored tokens of one scene.
pub(crate) struct Stored<'a> {
    /// `[1, S, D]`
    pub tokens: Tensor<3>,
    /// The patch of the context views each stands on, `[S]`.
    pub ids: Vec<u32>,
    /// What draws them.
    pub renderer: &'a Renderer,
}

impl<'a> Stored<'a> {
    /// Makes a variant's tokens, rounded as a scene file would round them; random subsets have no file.
    pub fn new(
        variant: Variant,
        networks: &'a Networks,
        lift: &Tensor<3>,
        index: &GroupsOnce,
        storage: TokenStorage,
    ) -> Result<Self, EvalError> {
        let device = &networks.device;
        if variant == Variant::Random {
            let ids = random_subset(lift.dims()[1], index.num_clusters, index.seed);
            return Ok(Self { tokens: rows_of(lift, &ids), ids, renderer: &networks.renderer });
        }
        let clusters = match variant {
            Variant::Kmeans | Variant::Clift => index.clusters()?,
            Variant::Patch | Variant::PatchClift => index.tiles()?,
            _ => return Err(EvalError::NotRendered { variant: variant.name() }),
        };
        let uploaded = clusters.upload(device);
        let (tokens, renderer) = match variant {
            Variant::Clift | Variant::PatchClift => {
                let condensed = networks.condensed_of(variant);
                let condensed = condensed.ok_or(EvalError::NoCondenser { variant: variant.name() })?;
                (condensed.condenser.forward(lift.clone(), &uploaded), &condensed.renderer)
            }
            _ => (uploaded.gather_centroids(lift.clone()), &networks.renderer),
        };
        let ids = clusters.scenes()[0].centroid_index().to_vec();
        Ok(Self { tokens: rounded(tokens, storage)?, ids, renderer })
    }
}

/// Groups of one count, made when the first variant asks.
pub(crate) struct GroupsOnce<'a> {
    pub kmeans: &'a KMeans,
    pub lift: &'a Tensor<3>,
    pub num_clusters: usize,
    pub seed: u64,
    /// Context views, and rows and columns of tokens of each.
    pub views: (usize, [usize; 2]),
    fit: OnceCell<Fit>,
    tiles: OnceCell<Clusters>,
}

impl<'a> GroupsOnce<'a> {
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

    fn fit(&self) -> Result<&Fit, EvalError> {
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

/// Some tokens of one scene, `[1, N, D]` to `[1, R, D]`.
pub(crate) fn rows_of(tokens: &Tensor<3>, ids: &[u32]) -> Tensor<3> {
    let index: Vec<i64> = ids.iter().map(|&id| i64::from(id)).collect();
    let index = Tensor::<1, Int>::from_data(TensorData::new(index, [ids.len()]), &tokens.device());
    tokens.clone().select(1, index)
}

/// `count` tokens of one scene without replacement, in order.
fn random_subset(num_tokens: usize, count: usize, seed: u64) -> Vec<u32> {
    let mut ids: Vec<u32> = (0..num_tokens as u32).collect();
    ids.shuffle(&mut item_rng(seed, 0, 0, 0, "random subset"));
    ids.truncate(count);
    ids.sort_unstable();
    ids
}

/// Tokens `[1, S, D]` as they would come back from a scene file.
fn rounded(tokens: Tensor<3>, storage: TokenStorage) -> Result<Tensor<3>, EvalError> {
    if storage == TokenStorage::F32 {
        return Ok(tokens);
    }
    let (shape, device) = (tokens.dims(), tokens.device());
    let values: Vec<f32> = tokens.into_data().convert::<f32>().try_to_vec().map_err(EvalError::tensor)?;
    let values = storage.round(&values, shape[2])?;
    Ok(Tensor::from_data(TensorData::new(values, shape), &device))
}

#[cfg(test)]
mod tests {
    use burn::tensor::Device;

    use super::*;

    #[test]
    fn random_subsets_are_distinct_nested_and_of_the_seed() {
        let (few, more) = (random_subset(50, 5, 1), random_subset(50, 20, 1));
        assert!(few.iter().all(|token| more.contains(token)));
        assert!(more.windows(2).all(|pair| pair[0] < pair[1]));
        assert_ne!(few, random_subset(50, 5, 2));
    }

    #[test]
    fn rows_are_taken_by_id() {
        let tokens = Tensor::<1, Int>::arange(0..6, &Device::flex()).float().reshape([1, 3, 2]);
        let rows: Vec<f32> = rows_of(&tokens, &[0, 2]).into_data().try_to_vec().expect("f32");
        assert_eq!(rows, [0.0, 1.0, 4.0, 5.0]);
    }
}
