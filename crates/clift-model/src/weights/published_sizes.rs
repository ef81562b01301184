//! The sizes of a network, inferred from the keys and shapes of its checkpoint.

use std::collections::BTreeMap;

use crate::network::architecture::CliftVariant;
use crate::network::config::{CondenserConfig, ModelConfig};
use crate::weights::published_keys::linear_shape;

/// Sizes of a network, inferred from its checkpoint.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct InferredConfig {
    /// Sizes of the network; the published size where the checkpoint lacks the tensors. A comparison with
    /// [`published_tensors`](crate::published_tensors) then lists the missing tensors.
    pub config: ModelConfig,
    /// Whether the checkpoint has a condenser.
    pub has_condenser: bool,
    /// Whether the number of heads is known: given, inferred from norms, or implied by the published width.
    pub has_num_heads: bool,
}

/// Infers the sizes of a network from keys without prefix and their shapes, which are empty for values that are not tensors.
///
/// Shapes determine the number of heads only in the variant with norms of heads; `num_heads` gives it for the others.
pub fn infer_config<'a>(
    variant: CliftVariant,
    num_heads: Option<usize>,
    shapes: impl Iterator<Item = (&'a str, &'a [u64])>,
) -> InferredConfig {
    let shapes: BTreeMap<&str, &[u64]> = shapes.map(|(key, shape)| (key, linear_shape(key, shape))).collect();
    let size = |key: &str| {
        let size = shapes.get(key)?.first()?;
        usize::try_from(*size).ok().filter(|size| *size > 0)
    };
    // The most frequent size: one misshapen tensor does not change it.
    let common = |ending: &str| {
        let is_layer = |key: &str| key.starts_with("decoder.layers.") || key.starts_with("encoder.layers.");
        let mut counts = BTreeMap::<usize, usize>::new();
        let keys = shapes.keys().copied().filter(|key| is_layer(key) && key.ends_with(ending));
        keys.filter_map(size).for_each(|size| *counts.entry(size).or_insert(0) += 1);
        counts.into_iter().rev().max_by_key(|(_, count)| *count).map(|(size, _)| size)
    };
    // One more than the largest number of a layer with at least half of the keys of the layer with the most: single stray keys do
    // not count.
    let count = |prefix: &str| {
        let number = |key: &&str| key.strip_prefix(prefix)?.split_once('.')?.0.parse::<usize>().ok();
        let mut layers = BTreeMap::<usize, usize>::new();
        shapes.keys().filter_map(number).for_each(|number| *layers.entry(number).or_insert(0) += 1);
        let most = layers.values().copied().max()?;
        let last = layers.into_iter().rev().find(|(_, count)| count * 2 >= most);
        last.map(|(number, _)| number.saturating_add(1))
    };
    let published = ModelConfig::default();
    let dim = common(".norm1.weight").unwrap_or(published.dim);
    let head_width = size("encoder.layers.0.self_attn.q_norm.weight").filter(|size| dim.is_multiple_of(*size));
    let num_heads = num_heads.or(head_width.filter(|_| variant.has_norms()).map(|size| dim / size));
    let has_condenser = shapes.keys().any(|key| key.starts_with("squeezer."));
    let mut condenser = CondenserConfig::of(variant);
    if variant == CliftVariant::Paper {
        condenser.num_blocks = count("squeezer.blocks.").unwrap_or(condenser.num_blocks);
        condenser.residual = !has_condenser || shapes.contains_key("squeezer.blocks.0.norm_cross.weight");
    }
    let config = ModelConfig {
        variant,
        dim,
        num_heads: num_heads.unwrap_or(published.num_heads),
        feed_forward_dim: common(".linear1.weight").unwrap_or(published.feed_forward_dim),
        num_encoder_blocks: count("encoder.layers.").unwrap_or(published.num_encoder_blocks),
        num_renderer_blocks: count("decoder.layers.").unwrap_or(published.num_renderer_blocks),
        // RGB of every pixel of a patch.
        patch_size: size("patch_to_image.0.weight").map_or(published.patch_size, |values| (values / 3).isqrt()),
        condenser,
        ..published
    };
    let has_num_heads = num_heads.is_some() || dim == ModelConfig::default().dim;
    InferredConfig { config, has_condenser, has_num_heads }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::small_config;
    use crate::weights::published_keys::published_tensors;

    #[test]
    fn heads_follow_from_norms_or_the_published_width() {
        let knows = |variant, dim| {
            let config = ModelConfig { dim, ..small_config(variant) };
            let wide = |shape: Vec<usize>| shape.into_iter().map(|size| size as u64).collect();
            let tensors = published_tensors(&config, true).into_iter();
            let shapes: Vec<(String, Vec<u64>)> = tensors.map(|tensor| (tensor.key, wide(tensor.shape))).collect();
            let got = infer_config(variant, None, shapes.iter().map(|(key, shape)| (key.as_str(), &shape[..])));
            (got.has_num_heads, got.config.num_heads)
        };
        assert_eq!(knows(CliftVariant::ReleasedDl3dv, 15), (true, 3));
        assert_eq!(knows(CliftVariant::ReleasedRe10k, 768), (true, 8));
        assert!(!knows(CliftVariant::ReleasedRe10k, 15).0 && !knows(CliftVariant::Paper, 15).0);
    }
}
