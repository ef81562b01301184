//! The names that the parameters have in published checkpoints and in the PyTorch twin, and those they have here.
//!
//! A key of a checkpoint is one tensor there and one or two parameters here: PyTorch packs the projections of
//! cross-attention into one matrix. Shapes are PyTorch's, linear weights `[outputs, inputs]`.

use std::ops::Range;

use crate::network::config::ModelConfig;
use crate::network::layers::Part;

/// Below which prefix a training program's checkpoint keeps the network.
pub const PREFIX: &str = "transformer.";

/// Keys of a checkpoint that are known to be no part of the network: the network of its perceptual loss.
pub const PERCEPTUAL_PREFIX: &str = "perceptual_loss.";

/// Layers that may be convolutions of one pixel in a checkpoint, `[outputs, inputs, 1, 1]`.
pub const PROJECTIONS: [&str; 3] = ["linear_input", "linear_target", "patch_to_image.0"];

/// Which of those are, in what is exported from a model that was not imported.
pub const CONVOLUTIONS: [&str; 2] = ["linear_input", "linear_target"];

/// One tensor of a checkpoint.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PublishedTensor {
    /// Its key, without a prefix.
    pub key: String,
    /// Its shape.
    pub shape: Vec<usize>,
    /// What it is here: paths in weight files, each with its rows of the tensor.
    pub parts: Vec<(String, Range<usize>)>,
}

impl PublishedTensor {
    /// Whether a shape is this tensor's, where a projection may be a convolution of one pixel.
    pub fn fits(&self, shape: &[u64]) -> bool {
        let shape = match shape {
            [outer @ .., 1, 1] if outer.len() == 2 && is_projection(&self.key) => outer,
            shape => shape,
        };
        shape.len() == self.shape.len() && shape.iter().zip(&self.shape).all(|(&got, &expected)| got == expected as u64)
    }
}

/// Whether a key is the weight of a layer that may be a convolution.
pub fn is_projection(key: &str) -> bool {
    key.strip_suffix(".weight").is_some_and(|layer| PROJECTIONS.contains(&layer))
}

/// Paths of modules, and the start of their keys; the first that fits is taken.
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

/// Layers inside a block that follows PyTorch's transformer layers.
const LAYERS: [(&str, &str); 13] = [
    (".attn.", ".self_attn."),
    (".cross_attn.", ".multihead_attn."),
    (".cluster_attn.", ".multihead_attn."),
    (".in_proj.", ".in_proj_"),
    // One packed matrix there, queries apart from keys and values here.
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

/// Lists every tensor of a model's checkpoint, with or without the condenser.
pub fn published_tensors(config: &ModelConfig, has_condenser: bool) -> Vec<PublishedTensor> {
    let mut list: Vec<PublishedTensor> = Vec::new();
    for layer in config.layers().iter().filter(|layer| has_condenser || layer.part != Part::Condenser) {
        for (path, shape) in layer.parameters() {
            let key = published_key(&path);
            // Weight and bias of the queries come right before those of the keys and values.
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

/// Returns the key of a parameter in a checkpoint: its path where no rule fits.
fn published_key(path: &str) -> String {
    let mut modules = MODULES.iter();
    let found = modules.find_map(|(module, key)| path.strip_prefix(module).map(|layer| (key, layer.to_owned())));
    let Some((module, mut layer)) = found else { return path.to_owned() };
    if path.starts_with("condenser.blocks") {
        // The paper's block has the names of this project.
        layer = layer.replace(".in_proj.", ".in_proj_");
    } else {
        let norm_ff = (".norm_ff.", if path.starts_with("encoder") { ".norm2." } else { ".norm3." });
        for (ours, theirs) in LAYERS.into_iter().chain([norm_ff]) {
            layer = layer.replace(ours, theirs);
        }
    }
    format!("{module}{layer}")
}

/// A key as this module writes it: without what a compiled or distributed model adds to names, and with one name for
/// the norms of queries and keys, whose name in published checkpoints is not known.
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
    use std::collections::BTreeMap;

    use super::*;
    use crate::network::architecture::CliftVariant;
    use crate::network::config::CondenserConfig;
    use crate::network::layers::Layer;
    use crate::testing::{small_config, small_configs};

    #[test]
    fn every_parameter_is_in_one_tensor_with_its_shape() {
        for config in small_configs() {
            let mut expected: BTreeMap<_, _> = config.layers().iter().flat_map(Layer::parameters).collect();
            for tensor in published_tensors(&config, true) {
                let mut next = 0;
                for (path, rows) in tensor.parts {
                    assert_eq!(rows.start, next, "{}", tensor.key);
                    next = rows.end;
                    let mut shape = tensor.shape.clone();
                    shape[0] = rows.len();
                    assert_eq!(expected.remove(&path), Some(shape), "{path}");
                }
                assert_eq!(next, tensor.shape[0], "{}", tensor.key);
            }
            assert!(expected.is_empty(), "{config:?}: {:?}", expected.keys());
        }
    }

    #[test]
    fn the_published_network_has_the_published_number_of_parameters() {
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
        // Two gammas of 96 in each of the 6 + 12 + 2 attentions, and a layer norm.
        assert_eq!(
            count(CliftVariant::ReleasedDl3dv, true) - count(CliftVariant::ReleasedRe10k, true),
            20 * 2 * 96 + 2 * 768
        );
    }

    #[test]
    fn names_that_tools_add_are_taken_off() {
        assert_eq!(canonical_key("_orig_mod.encoder.layers.0.norm1.weight"), "encoder.layers.0.norm1.weight");
        assert_eq!(
            canonical_key("encoder.layers.0.self_attn.query_norm.scale"),
            "encoder.layers.0.self_attn.q_norm.weight"
        );
        assert_eq!(canonical_key("output_norm.weight"), "output_norm.weight");
    }

    #[test]
    fn a_projection_may_be_a_convolution_and_nothing_else_may() {
        let all = published_tensors(&small_config(CliftVariant::ReleasedRe10k), true);
        let fits = |key: &str, shape: &[u64]| all.iter().find(|tensor| tensor.key == key).expect("known").fits(shape);
        assert!(fits("linear_input.weight", &[15, 576]) && fits("linear_input.weight", &[15, 576, 1, 1]));
        assert!(!fits("linear_input.weight", &[15, 576, 1]) && !fits("linear_input.weight", &[15, 64, 3, 3]));
        assert!(!fits("squeezer.linear1.weight", &[15, 15, 1, 1]) && !fits("linear_input.bias", &[15, 1, 1]));
    }
}
