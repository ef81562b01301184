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
const PROJECTIONS: [&str; 3] = ["linear_input", "linear_target", "patch_to_image.0"];

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

/// Returns a key in the form of [`PublishedTensor::key`]: without the segments that compiled and distributed models add.
pub fn canonical_key(key: &str) -> String {
    let parts: Vec<&str> = key.split('.').filter(|part| !matches!(*part, "_orig_mod" | "module")).collect();
    parts.join(".")
}
