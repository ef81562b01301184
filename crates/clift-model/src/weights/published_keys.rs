//! Parameter names of published checkpoints and the PyTorch twin, mapped to parameter paths of this crate.
//!
//! A tensor of a checkpoint is one or two parameters of this crate: PyTorch packs the projections of cross-attention into
//! one matrix. Shapes are PyTorch's, linear weights `[outputs, inputs]`.

use std::ops::Range;

use crate::network::config::ModelConfig;
use crate::network::layers::Part;

/// Prefix of the network's keys in a checkpoint of the published training program.
pub const PREFIX: &str = "transformer.";
/// Prefix of the keys of the perceptual loss, which is not part of the network.
pub const PERCEPTUAL_PREFIX: &str = "perceptual_loss.";

/// Layers that are 1 x 1 convolutions in the published module, `[outputs, inputs, 1, 1]`; linear layers are read too.
pub const PROJECTIONS: [&str; 3] = ["linear_input", "linear_target", "patch_to_image.0"];

/// One tensor of a checkpoint.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PublishedTensor {
    /// Key without a prefix.
    pub key: String,
    /// Shape in the checkpoint.
    pub shape: Vec<usize>,
    /// Paths of its parameters in weight files, each with its rows of the tensor.
    pub parts: Vec<(String, Range<usize>)>,
}

impl PublishedTensor {
    /// Whether a shape is this tensor's; a projection may be a 1 x 1 convolution.
    pub fn fits(&self, shape: &[u64]) -> bool {
        let shape = linear_shape(&self.key, shape);
        shape.len() == self.shape.len() && shape.iter().zip(&self.shape).all(|(&got, &expected)| got == expected as u64)
    }
}

/// Returns the shape as that of a linear weight: without the sides of a 1 x 1 convolution, which the weights of the
/// [`PROJECTIONS`] may be.
pub(crate) fn linear_shape<'a>(key: &str, shape: &'a [u64]) -> &'a [u64] {
    let is_projection = || key.strip_suffix(".weight").is_some_and(|layer| PROJECTIONS.contains(&layer));
    match shape {
        [outer @ .., 1, 1] if outer.len() == 2 && is_projection() => outer,
        shape => shape,
    }
}

/// Paths of modules and the start of their keys. The first matching path counts.
const MODULES: [(&str, &str); 10] = [
    ("encoder.patch_embed", "linear_input"),
    ("encoder.blocks", "encoder.layers"),
    ("lift_norm.norm", "input_norm"),
    ("renderer.ray_embed", "linear_target"),
    ("renderer.blocks", "decoder.layers"),
    ("renderer.output_norm", "output_norm"),
    ("renderer.to_pixels", "patch_to_image.0"),
    ("condenser.released.gate", "squeezer.linear1"),
    ("condenser.released", "squeezer.cross_attn"),
    ("condenser.blocks", "squeezer.blocks"),
];

/// Path segments of layers in a block, and those of PyTorch's transformer layers.
const LAYERS: [(&str, &str); 13] = [
    (".attn.", ".self_attn."),
    (".cross_attn.", ".multihead_attn."),
    (".cluster_attn.", ".multihead_attn."),
    (".in_proj.", ".in_proj_"),
    // PyTorch packs queries, keys and values into one matrix.
    (".q_proj.", ".in_proj_"),
    (".kv_proj.", ".in_proj_"),
    (".qk_norm.query.", ".q_norm."),
    (".qk_norm.key.", ".k_norm."),
    (".feed_forward.up.", ".linear1."),
    (".feed_forward.down.", ".linear2."),
    (".norm_attn.", ".norm1."),
    (".norm_self.", ".norm1."),
    (".norm_cross.", ".norm2."),
];

/// Lists all tensors of a model's checkpoint, with or without the condenser.
pub fn published_tensors(config: &ModelConfig, has_condenser: bool) -> Vec<PublishedTensor> {
    let mut list: Vec<PublishedTensor> = Vec::new();
    for layer in config.layers().iter().filter(|layer| has_condenser || layer.part != Part::Condenser) {
        for (path, shape) in layer.parameters() {
            let key = published_key(&path);
            // Weight and bias of the queries immediately precede those of the keys and values.
            if let Some(packed) = list.iter_mut().rev().take(2).find(|tensor| tensor.key == key) {
                let first = packed.shape[0];
                packed.shape[0] += shape[0];
                packed.parts.push((path, first..packed.shape[0]));
            } else {
                let parts = vec![(path, 0..shape[0])];
                list.push(PublishedTensor { key, shape, parts });
            }
        }
    }
    list
}

/// Returns the key of a parameter in a checkpoint; its path if no module matches.
fn published_key(path: &str) -> String {
    let mut modules = MODULES.iter();
    let found = modules.find_map(|(module, key)| path.strip_prefix(module).map(|layer| (key, layer.to_owned())));
    let Some((module, mut layer)) = found else { return path.to_owned() };
    if path.starts_with("condenser.blocks") {
        // The twin names the layers of the paper's block as this crate does.
        layer = layer.replace(".in_proj.", ".in_proj_");
    } else {
        let norm_ff = (".norm_ff.", if path.starts_with("encoder") { ".norm2." } else { ".norm3." });
        for (ours, theirs) in LAYERS.into_iter().chain([norm_ff]) {
            layer = layer.replace(ours, theirs);
        }
    }
    format!("{module}{layer}")
}

/// Returns a key in the form of [`PublishedTensor::key`]: without the segments that compiled and distributed models add,
/// and with one name for the norms of queries and keys, whose published name is unknown.
pub fn canonical_key(key: &str) -> String {
    let mut parts: Vec<&str> = key.split('.').filter(|part| !matches!(*part, "_orig_mod" | "module")).collect();
    if let [.., norm, last] = &mut parts[..] {
        let known = match *norm {
            "q_norm" | "norm_q" | "query_norm" | "qnorm" | "q_rms_norm" | "q_rmsnorm" | "q_layernorm" | "q_ln" => {
                Some("q_norm")
            }
            "k_norm" | "norm_k" | "key_norm" | "knorm" | "k_rms_norm" | "k_rmsnorm" | "k_layernorm" | "k_ln" => {
                Some("k_norm")
            }
            _ => None,
        };
        if let Some(known) = known {
            *norm = known;
            if matches!(*last, "gamma" | "scale" | "g") {
                *last = "weight";
            }
        }
    }
    parts.join(".")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::network::architecture::CliftVariant;
    use crate::network::config::CondenserConfig;
    use crate::testing::small_config;

    #[test]
    fn parameter_counts_equal_the_published_ones() {
        let count = |variant, condenser| {
            let config = ModelConfig { variant, condenser: CondenserConfig::of(variant), ..ModelConfig::default() };
            published_tensors(&config, condenser)
                .iter()
                .map(|tensor| tensor.shape.iter().product::<usize>())
                .sum::<usize>()
        };
        assert_eq!(count(CliftVariant::ReleasedRe10k, false), 81_239_232); // 81.2 million
        let condenser = count(CliftVariant::ReleasedRe10k, true) - count(CliftVariant::ReleasedRe10k, false);
        assert_eq!(condenser, 8_468_480); // 8.5 million
        // Two gammas of 96 in each of the 6 + 12 attentions of encoder and renderer, and a layer norm.
        assert_eq!(
            count(CliftVariant::ReleasedDl3dv, true) - count(CliftVariant::ReleasedRe10k, true),
            18 * 2 * 96 + 2 * 768
        );
    }

    #[test]
    fn canonical_keys_lack_the_segments_of_wrappers() {
        assert_eq!(canonical_key("_orig_mod.encoder.layers.0.norm1.weight"), "encoder.layers.0.norm1.weight");
        assert_eq!(
            canonical_key("encoder.layers.0.self_attn.query_norm.scale"),
            "encoder.layers.0.self_attn.q_norm.weight"
        );
        assert_eq!(canonical_key("output_norm.weight"), "output_norm.weight");
    }

    #[test]
    fn only_projections_may_be_convolutions() {
        let all = published_tensors(&small_config(CliftVariant::ReleasedRe10k), true);
        let fits = |key: &str, shape: &[u64]| all.iter().find(|tensor| tensor.key == key).expect("known").fits(shape);
        assert!(fits("linear_input.weight", &[15, 576]) && fits("linear_input.weight", &[15, 576, 1, 1]));
        assert!(!fits("linear_input.weight", &[15, 576, 1]) && !fits("linear_input.weight", &[15, 64, 3, 3]));
        assert!(!fits("squeezer.linear1.weight", &[15, 15, 1, 1]) && !fits("linear_input.bias", &[15, 1, 1]));
    }
}
