//! The sizes of a network, inferred from the keys and shapes of its checkpoint.
//!
//! Every tensor dimension that depends on a size votes for the size, so that one tensor with a wrong shape does not change
//! the result.
// D width, F hidden width, E width of a head

use std::collections::BTreeMap;

use crate::network::architecture::CliftVariant;
use crate::network::config::{CondenserConfig, ModelConfig};
use crate::weights::published_keys::{linear_shape, published_tensors};

/// Key prefixes before the number of a layer.
const LAYERS: [&str; 3] = ["encoder.layers.", "decoder.layers.", "squeezer.blocks."];

/// Sizes of a network, inferred from its checkpoint.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct InferredConfig {
    /// Sizes of the network; the published size where the checkpoint lacks the tensors. A comparison with
    /// [`published_tensors`] then lists the missing tensors.
    pub config: ModelConfig,
    /// Whether the checkpoint has a condenser.
    pub has_condenser: bool,
    /// Whether the number of heads is known: given, inferred from norms, or implied by the published width.
    pub has_num_heads: bool,
    /// The first key that voted for the width.
    pub width_key: Option<String>,
}

/// Number of votes for each size, and the key of the first.
#[derive(Default)]
struct Votes(BTreeMap<usize, (usize, String)>);

impl Votes {
    fn add(&mut self, size: usize, key: &str) {
        self.0.entry(size).or_insert_with(|| (0, key.to_owned())).0 += 1;
    }

    /// Returns the size with the most votes, the smaller of two with equal votes, and its first key.
    fn winner(&self) -> Option<(usize, &str)> {
        let (size, (_, key)) = self.0.iter().rev().max_by_key(|(_, (count, _))| *count)?;
        Some((*size, key))
    }
}

/// Returns a network whose sizes differ, so that every dimension of a tensor identifies the size.
fn probe(variant: CliftVariant) -> ModelConfig {
    ModelConfig {
        variant,
        dim: 11 * 101,
        num_heads: 11,
        feed_forward_dim: 1009,
        num_encoder_blocks: 1,
        num_renderer_blocks: 1,
        patch_size: 8,
        condenser: CondenserConfig { num_blocks: 1, ..CondenserConfig::of(variant) },
        ..ModelConfig::default()
    }
}

/// Infers the sizes of a network from keys without prefix and their shapes, which are empty for values that are not tensors.
///
/// Shapes determine the number of heads only in the variant with norms of heads; `num_heads` gives it for the others.
pub fn infer_config<'a>(
    variant: CliftVariant,
    num_heads: Option<usize>,
    shapes: impl Iterator<Item = (&'a str, &'a [u64])>,
) -> InferredConfig {
    let probe = probe(variant);
    let known: BTreeMap<String, Vec<usize>> =
        published_tensors(&probe, true).into_iter().map(|tensor| (tensor.key, tensor.shape)).collect();
    let [mut width, mut hidden, mut patch, mut head] = [(); 4].map(|()| Votes::default());
    let mut layers: [BTreeMap<usize, usize>; 3] = Default::default();
    let (mut has_condenser, mut has_norm_cross) = (false, false);
    for (key, shape) in shapes {
        let mut first = key.to_owned();
        for (prefix, counts) in LAYERS.iter().zip(&mut layers) {
            let numbered = key.strip_prefix(prefix).and_then(|rest| rest.split_once('.'));
            if let Some((Ok(number), rest)) = numbered.map(|(number, rest)| (number.parse::<usize>(), rest)) {
                *counts.entry(number).or_insert(0) += 1;
                first = format!("{prefix}0.{rest}");
            }
        }
        has_condenser |= key.starts_with("squeezer.");
        has_norm_cross |= first == "squeezer.blocks.0.norm_cross.weight";
        let Some(expected) = known.get(&first) else { continue };
        let shape = linear_shape(key, shape);
        if shape.len() != expected.len() {
            continue;
        }
        for (&got, &expected) in shape.iter().zip(expected) {
            let got = usize::try_from(got).unwrap_or(usize::MAX);
            let (pixels, pixel_values) = (probe.patch_size.pow(2), expected / probe.patch_size.pow(2));
            if expected == probe.feed_forward_dim {
                hidden.add(got, key);
            } else if expected == probe.dim / probe.num_heads {
                head.add(got, key);
            } else if expected.is_multiple_of(probe.dim) && got.is_multiple_of(expected / probe.dim) {
                width.add(got / (expected / probe.dim), key); // D, 2D or 3D
            } else if expected.is_multiple_of(pixels) && got.is_multiple_of(pixel_values) {
                let side = (got / pixel_values).isqrt();
                if side * side * pixel_values == got {
                    patch.add(side, key);
                }
            }
        }
    }

    let published = ModelConfig::default();
    // A layer counts if it has at least half of the keys of the layer with the most: single stray keys do not count.
    let [encoder, renderer, condenser] = layers.map(|counts| {
        let most = counts.values().copied().max().unwrap_or(0);
        let last = counts.iter().rev().find(|(_, count)| **count * 2 >= most);
        last.map(|(number, _)| number.saturating_add(1))
    });
    let mut config = ModelConfig {
        variant,
        dim: width.winner().map_or(published.dim, |(size, _)| size),
        num_heads: published.num_heads,
        feed_forward_dim: hidden.winner().map_or(published.feed_forward_dim, |(size, _)| size),
        num_encoder_blocks: encoder.unwrap_or(published.num_encoder_blocks),
        num_renderer_blocks: renderer.unwrap_or(published.num_renderer_blocks),
        patch_size: patch.winner().map_or(published.patch_size, |(size, _)| size),
        condenser: CondenserConfig::of(variant),
        ..ModelConfig::default()
    };
    if variant == CliftVariant::Paper {
        config.condenser.num_blocks = condenser.unwrap_or(config.condenser.num_blocks);
        config.condenser.residual = !has_condenser || has_norm_cross;
    }
    let inferred = head.winner().map(|(size, _)| size).filter(|size| *size > 0 && config.dim.is_multiple_of(*size));
    let num_heads = num_heads.or(inferred.map(|size| config.dim / size));
    let has_num_heads = num_heads.is_some() || config.dim == published.dim;
    config.num_heads = num_heads.unwrap_or(published.num_heads);
    InferredConfig { config, has_condenser, has_num_heads, width_key: width.winner().map(|(_, key)| key.to_owned()) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::small_config;

    type Shapes = BTreeMap<String, Vec<u64>>;

    fn shapes(config: &ModelConfig, has_condenser: bool) -> Shapes {
        let wide = |shape: Vec<usize>| shape.into_iter().map(|size| size as u64).collect();
        published_tensors(config, has_condenser).into_iter().map(|tensor| (tensor.key, wide(tensor.shape))).collect()
    }

    fn read(variant: CliftVariant, num_heads: Option<usize>, shapes: &Shapes) -> InferredConfig {
        infer_config(variant, num_heads, shapes.iter().map(|(key, shape)| (key.as_str(), &shape[..])))
    }

    #[test]
    fn sizes_are_inferred_from_shapes() {
        for variant in CliftVariant::ALL {
            for residual in [true, false] {
                for with_condenser in [true, false] {
                    let mut config = small_config(variant);
                    config.condenser.residual = residual || variant != CliftVariant::Paper || !with_condenser;
                    let heads = (!variant.has_norms()).then_some(3);
                    let got = read(variant, heads, &shapes(&config, with_condenser));
                    assert_eq!((got.config, got.has_condenser, got.has_num_heads), (config, with_condenser, true));
                }
            }
        }
    }

    #[test]
    fn one_wrong_shape_does_not_change_the_sizes() {
        for variant in CliftVariant::ALL {
            let config = small_config(variant);
            let all = shapes(&config, true);
            for key in all.keys() {
                let mut changed = all.clone();
                for size in changed.get_mut(key).expect("a key of the checkpoint") {
                    *size = *size * 4 + 36;
                }
                let got = read(variant, Some(3), &changed);
                assert_eq!(got.config, config, "{key}");
            }
        }
    }

    #[test]
    fn stray_keys_and_missing_layers_do_not_change_the_sizes() {
        let config = small_config(CliftVariant::ReleasedRe10k);
        let mut stray = shapes(&config, true);
        stray.insert("decoder.layers.3.norm1.weight".into(), vec![15]);
        stray.insert("encoder.layers.18446744073709551615.norm1.weight".into(), vec![15]);
        assert_eq!(read(config.variant, Some(3), &stray).config, config);
        let mut gap = shapes(&config, true);
        gap.retain(|key, _| !key.starts_with("decoder.layers.1."));
        assert_eq!(read(config.variant, Some(3), &gap).config, config);
    }

    #[test]
    fn heads_follow_from_norms_or_the_published_width() {
        let knows = |variant, dim| {
            let config = ModelConfig { dim, ..small_config(variant) };
            let got = read(variant, None, &shapes(&config, true));
            (got.has_num_heads, got.config.num_heads)
        };
        assert_eq!(knows(CliftVariant::ReleasedDl3dv, 15), (true, 3));
        assert_eq!(knows(CliftVariant::ReleasedRe10k, 768), (true, 8));
        assert!(!knows(CliftVariant::ReleasedRe10k, 15).0 && !knows(CliftVariant::Paper, 15).0);
    }
}
