//! The stored tokens of a scene, by method, and the model that renders them.
// N encoder tokens, S stored tokens, R rendered tokens, D width

use burn::tensor::{Tensor, TensorData};
use clift_data::item_rng;
use clift_model::{SceneModel, TokenFormat, Tokens, TrainedModel};
use rand::Rng;
use rand::seq::SliceRandom;

use crate::config::method::Method;
use crate::error::EvalError;
use crate::sweep::eval_models::EvalModels;
use crate::sweep::lazy_clusters::LazyClusters;

pub(crate) struct CompressedTokens<'a> {
    /// `[1, S, D]`
    pub tokens: Tokens,
    /// The patch of the context views of every token, `[S]`.
    pub ids: Vec<u32>,
    pub model: &'a TrainedModel,
}

impl<'a> CompressedTokens<'a> {
    /// Makes the tokens of a method, rounded like the tokens of a scene file. Random subsets have no file and stay f32.
    pub fn new(
        method: Method,
        models: &'a EvalModels,
        lift: &Tokens,
        index: &LazyClusters,
        storage: TokenFormat,
    ) -> Result<Self, EvalError> {
        let model = models.for_method(method).ok_or(EvalError::NoModel { method: method.name() })?;
        if method == Method::Random {
            let ids = random_subset(lift.dims()[1], index.num_clusters, item_rng(index.seed, 0, 0, 0, "random subset"));
            return Ok(Self { tokens: lift.select(&ids), ids, model });
        }
        let is_tiled = matches!(method, Method::Patch | Method::PatchClift);
        let clusters = if is_tiled { index.tiles()? } else { index.clusters()? };
        let uploaded = clusters.upload(&model.device);
        let tokens = match method {
            Method::Clift | Method::PatchClift => model.network.compress(lift.clone(), &uploaded),
            _ => lift.centroids(&uploaded),
        };
        let ids = clusters.scenes()[0].centroid_index().to_vec();
        Ok(Self { tokens: rounded(tokens, storage)?, ids, model })
    }
}

/// Samples `count` of `num_tokens` ids without replacement, ascending.
pub(crate) fn random_subset(num_tokens: usize, count: usize, mut rng: impl Rng) -> Vec<u32> {
    let mut ids: Vec<u32> = (0..num_tokens as u32).collect();
    ids.shuffle(&mut rng);
    ids.truncate(count);
    ids.sort_unstable();
    ids
}

/// Rounds tokens `[1, S, D]` like a scene file of the format.
fn rounded(tokens: Tokens, storage: TokenFormat) -> Result<Tokens, EvalError> {
    if storage == TokenFormat::F32 {
        return Ok(tokens);
    }
    let (shape, device) = (tokens.dims(), tokens.values.device());
    let values: Vec<f32> =
        tokens.values.clone().into_data().convert::<f32>().try_to_vec().map_err(EvalError::tensor)?;
    let values = storage.round(&values, shape[2])?;
    Ok(tokens.with_values(Tensor::from_data(TensorData::new(values, shape), &device)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn random_subsets_are_nested_and_seeded() {
        let subset = |count, seed| random_subset(50, count, item_rng(seed, 0, 0, 0, "random subset"));
        let (few, more) = (subset(5, 1), subset(20, 1));
        assert!(few.iter().all(|token| more.contains(token)));
        assert!(more.windows(2).all(|pair| pair[0] < pair[1]));
        assert_ne!(few, subset(5, 2));
    }
}
