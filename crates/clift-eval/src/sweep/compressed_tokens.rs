//! The tokens a scene is stored with, by variant, and the model that renders them.
// N encoder tokens, S stored tokens, R rendered tokens, D width

use burn::tensor::{Int, Tensor, TensorData};
use clift_data::item_rng;
use clift_model::{SceneModel, TokenFormat, TrainedModel};
use rand::seq::SliceRandom;

use crate::config::method::Method;
use crate::error::EvalError;
use crate::sweep::eval_models::EvalModels;
use crate::sweep::lazy_clusters::LazyClusters;

/// Stored tokens of one scene.
pub(crate) struct CompressedTokens<'a> {
    /// `[1, S, D]`
    pub tokens: Tensor<3>,
    /// The patch of the context views each stands on, `[S]`.
    pub ids: Vec<u32>,
    /// Renders them.
    pub model: &'a TrainedModel,
}

impl<'a> CompressedTokens<'a> {
    /// Makes a variant's tokens, rounded as a scene file would round them; random subsets have no file.
    pub fn new(
        variant: Method,
        models: &'a EvalModels,
        lift: &Tensor<3>,
        index: &LazyClusters,
        storage: TokenFormat,
    ) -> Result<Self, EvalError> {
        let model = models.for_method(variant).ok_or(EvalError::NoModel { variant: variant.name() })?;
        if variant == Method::Random {
            let ids = random_subset(lift.dims()[1], index.num_clusters, index.seed);
            return Ok(Self { tokens: select_tokens(lift, &ids), ids, model });
        }
        let is_tiled = matches!(variant, Method::Patch | Method::PatchClift);
        let clusters = if is_tiled { index.tiles()? } else { index.clusters()? };
        let uploaded = clusters.upload(&model.device);
        let tokens = match variant {
            Method::Clift | Method::PatchClift => model.network.compress(lift.clone(), &uploaded),
            _ => uploaded.gather_centroids(lift.clone()),
        };
        let ids = clusters.scenes()[0].centroid_index().to_vec();
        Ok(Self { tokens: rounded(tokens, storage)?, ids, model })
    }
}

/// Some tokens of one scene, `[1, N, D]` to `[1, R, D]`.
pub(crate) fn select_tokens(tokens: &Tensor<3>, ids: &[u32]) -> Tensor<3> {
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
fn rounded(tokens: Tensor<3>, storage: TokenFormat) -> Result<Tensor<3>, EvalError> {
    if storage == TokenFormat::F32 {
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
        let rows: Vec<f32> = select_tokens(&tokens, &[0, 2]).into_data().try_to_vec().expect("f32");
        assert_eq!(rows, [0.0, 1.0, 4.0, 5.0]);
    }
}
