//! The names that the parameters have in published checkpoints and in the PyTorch twin, and those they have here.
//!
//! A key of a checkpoint is one tensor there and one or two parameters here: PyTorch packs the projections of
//! cross-attention into one matrix. Shapes are PyTorch's, linear weights `[outputs, inputs]`.
// D width, F hidden width, E width of a head

use std::ops::Range;

use crate::ModelConfig;

mod sizes;

pub use sizes::{Sizes, sizes};

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
pub struct CheckpointTensor {
    /// Its key, without a prefix.
    pub key: String,
    /// Its shape.
    pub shape: Vec<usize>,
    /// What it is here: paths in weight files, each with its rows of the tensor.
    pub parts: Vec<(String, Range<usize>)>,
}

impl CheckpointTensor {
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

/// Every tensor of a model's checkpoint, with or without the condenser.
pub fn tensors(config: &ModelConfig, has_condenser: bool) -> Vec<CheckpointTensor> {
    let mut list = Tensors { config, list: Vec::new() };
    let ModelConfig { dim, feed_forward_dim: hidden, .. } = *config;
    list.linear("linear_input", "encoder.patch_embed", [dim, config.context_patch_len()]);
    for i in 0..config.num_encoder_blocks {
        let (key, path) = (format!("encoder.layers.{i}"), format!("encoder.blocks.{i}"));
        list.self_attention(&format!("{key}.self_attn"), &format!("{path}.attn"));
        list.feed_forward(&key, &path, hidden);
        list.norm(&format!("{key}.norm1"), &format!("{path}.norm_attn"));
        list.norm(&format!("{key}.norm2"), &format!("{path}.norm_ff"));
    }
    if config.variant.has_norms() {
        list.norm("input_norm", "lift_norm.norm");
    }
    list.linear("linear_target", "renderer.ray_embed", [dim, config.ray_patch_len()]);
    for i in 0..config.num_renderer_blocks {
        list.decoder_layer(&format!("decoder.layers.{i}"), &format!("renderer.blocks.{i}"), "cross_attn");
    }
    list.norm("output_norm", "renderer.output_norm");
    list.linear("patch_to_image.0", "renderer.to_pixels", [config.rgb_patch_len(), dim]);
    if has_condenser && config.variant.is_released() {
        list.decoder_layer("squeezer.cross_attn", "condenser.released", "cluster_attn");
        list.linear("squeezer.linear1", "condenser.released.gate", [dim, dim]);
    } else if has_condenser {
        for i in 0..config.condenser.num_blocks {
            list.paper_condenser_block(&format!("squeezer.blocks.{i}"), &format!("condenser.blocks.{i}"));
        }
    }
    list.list
}

struct Tensors<'a> {
    config: &'a ModelConfig,
    list: Vec<CheckpointTensor>,
}

impl Tensors<'_> {
    fn whole(&mut self, key: String, path: String, shape: Vec<usize>) {
        let rows = 0..shape[0];
        self.list.push(CheckpointTensor { key, shape, parts: vec![(path, rows)] });
    }

    fn linear(&mut self, key: &str, path: &str, [outputs, inputs]: [usize; 2]) {
        self.whole(format!("{key}.weight"), format!("{path}.weight"), vec![outputs, inputs]);
        self.whole(format!("{key}.bias"), format!("{path}.bias"), vec![outputs]);
    }

    fn norm(&mut self, key: &str, path: &str) {
        for name in ["weight", "bias"] {
            self.whole(format!("{key}.{name}"), format!("{path}.{name}"), vec![self.config.dim]);
        }
    }

    fn feed_forward(&mut self, key: &str, path: &str, hidden: usize) {
        let dim = self.config.dim;
        self.linear(&format!("{key}.linear1"), &format!("{path}.feed_forward.up"), [hidden, dim]);
        self.linear(&format!("{key}.linear2"), &format!("{path}.feed_forward.down"), [dim, hidden]);
    }

    fn self_attention(&mut self, key: &str, path: &str) {
        let dim = self.config.dim;
        self.whole(format!("{key}.in_proj_weight"), format!("{path}.in_proj.weight"), vec![3 * dim, dim]);
        self.whole(format!("{key}.in_proj_bias"), format!("{path}.in_proj.bias"), vec![3 * dim]);
        self.attention_rest(key, path);
    }

    /// One packed matrix there, queries apart from keys and values here.
    fn cross_attention(&mut self, key: &str, path: &str) {
        let dim = self.config.dim;
        for (name, shape) in [("weight", vec![3 * dim, dim]), ("bias", vec![3 * dim])] {
            let parts =
                vec![(format!("{path}.q_proj.{name}"), 0..dim), (format!("{path}.kv_proj.{name}"), dim..3 * dim)];
            self.list.push(CheckpointTensor { key: format!("{key}.in_proj_{name}"), shape, parts });
        }
        self.attention_rest(key, path);
    }

    fn attention_rest(&mut self, key: &str, path: &str) {
        let ModelConfig { dim, num_heads, variant, .. } = *self.config;
        self.linear(&format!("{key}.out_proj"), &format!("{path}.out_proj"), [dim, dim]);
        if variant.has_norms() {
            let head_width = vec![dim / num_heads];
            self.whole(format!("{key}.q_norm.weight"), format!("{path}.qk_norm.query.weight"), head_width.clone());
            self.whole(format!("{key}.k_norm.weight"), format!("{path}.qk_norm.key.weight"), head_width);
        }
    }

    fn decoder_layer(&mut self, key: &str, path: &str, cross: &str) {
        self.self_attention(&format!("{key}.self_attn"), &format!("{path}.self_attn"));
        self.cross_attention(&format!("{key}.multihead_attn"), &format!("{path}.{cross}"));
        self.feed_forward(key, path, self.config.feed_forward_dim);
        for (there, here) in [("norm1", "norm_self"), ("norm2", "norm_cross"), ("norm3", "norm_ff")] {
            self.norm(&format!("{key}.{there}"), &format!("{path}.{here}"));
        }
    }

    /// The paper's block has the names of this project on both sides.
    fn paper_condenser_block(&mut self, key: &str, path: &str) {
        let ModelConfig { dim, feed_forward_dim: hidden, .. } = *self.config;
        let both = |name: &str| (format!("{key}.{name}"), format!("{path}.{name}"));
        let (attn, attn_here) = both("self_attn");
        self.self_attention(&attn, &attn_here);
        let norms: &[&str] = if self.config.condenser.residual {
            &["norm_self", "norm_cross", "norm_memory", "norm_ff"]
        } else {
            &["norm_self", "norm_memory", "norm_ff"]
        };
        for name in norms {
            let (there, here) = both(name);
            self.norm(&there, &here);
        }
        for (name, shape) in [
            ("cluster_attn.q_proj", [dim, dim]),
            ("cluster_attn.kv_proj", [2 * dim, dim]),
            ("cluster_attn.out_proj", [dim, dim]),
            ("feed_forward.up", [hidden, dim]),
            ("feed_forward.down", [dim, hidden]),
        ] {
            let (there, here) = both(name);
            self.linear(&there, &here, shape);
        }
        let (gate, gate_here) = both("gate.weight");
        self.whole(gate, gate_here, vec![dim, dim]);
    }
}

/// A key as this module writes it: without what a compiled or distributed model adds to names, and with one name for
/// the norms of queries and keys, whose name in published checkpoints is not known.
pub fn plain_key(key: &str) -> String {
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

    use burn::tensor::Device;

    use super::*;
    use crate::{Clift, CondenserConfig, Variant, weights};

    fn config(variant: Variant) -> ModelConfig {
        ModelConfig {
            variant,
            dim: 15,
            num_heads: 3,
            feed_forward_dim: 22,
            num_encoder_blocks: 1,
            num_renderer_blocks: 3,
            patch_size: 8,
            condenser: CondenserConfig::of(variant),
        }
    }

    #[test]
    fn every_parameter_of_a_weight_file_is_in_one_tensor_with_its_shape() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("model.safetensors");
        for variant in Variant::ALL {
            for residual in [true, false] {
                let mut config = config(variant);
                if variant == Variant::Paper {
                    config.condenser.residual = residual;
                }
                weights::save(&Clift::new(&config, 0, &Device::flex()), &path).expect("writes");
                let bytes = std::fs::read(&path).expect("reads");
                let file = safetensors::SafeTensors::deserialize(&bytes).expect("valid");
                let mut expected: BTreeMap<String, Vec<usize>> =
                    file.tensors().into_iter().map(|(name, view)| (name, view.shape().to_vec())).collect();
                for tensor in tensors(&config, true) {
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
                assert!(expected.is_empty(), "{variant}: {:?}", expected.keys());
            }
        }
    }

    #[test]
    fn the_published_network_has_the_published_number_of_parameters() {
        let count = |variant, condenser| {
            let config = ModelConfig { variant, condenser: CondenserConfig::of(variant), ..ModelConfig::default() };
            tensors(&config, condenser).iter().map(|tensor| tensor.shape.iter().product::<usize>()).sum::<usize>()
        };
        assert_eq!(count(Variant::ReleasedRe10k, false), 81_239_232); // 81.2 million
        let condenser = count(Variant::ReleasedRe10k, true) - count(Variant::ReleasedRe10k, false);
        assert_eq!(condenser, 8_468_480); // 8.5 million
        // Two gammas of 96 in each of the 6 + 12 + 2 attentions, and a layer norm.
        assert_eq!(count(Variant::ReleasedDl3dv, true) - count(Variant::ReleasedRe10k, true), 20 * 2 * 96 + 2 * 768);
    }

    #[test]
    fn names_that_tools_add_are_taken_off() {
        assert_eq!(plain_key("_orig_mod.encoder.layers.0.norm1.weight"), "encoder.layers.0.norm1.weight");
        assert_eq!(
            plain_key("encoder.layers.0.self_attn.query_norm.scale"),
            "encoder.layers.0.self_attn.q_norm.weight"
        );
        assert_eq!(plain_key("output_norm.weight"), "output_norm.weight");
    }

    #[test]
    fn a_projection_may_be_a_convolution_and_nothing_else_may() {
        let all = tensors(&config(Variant::ReleasedRe10k), true);
        let fits = |key: &str, shape: &[u64]| all.iter().find(|tensor| tensor.key == key).expect("known").fits(shape);
        assert!(fits("linear_input.weight", &[15, 576]) && fits("linear_input.weight", &[15, 576, 1, 1]));
        assert!(!fits("linear_input.weight", &[15, 576, 1]) && !fits("linear_input.weight", &[15, 64, 3, 3]));
        assert!(!fits("squeezer.linear1.weight", &[15, 15, 1, 1]) && !fits("linear_input.bias", &[15, 1, 1]));
    }
}
