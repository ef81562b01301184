//! The networks of the published checkpoints: `CLiFT` with another condenser.
// B scenes, N tokens, S centroids, D width

use burn::module::Module;
use burn::nn::{LayerNorm, Linear};

use crate::error::ModelError;
use crate::network::architecture::{CameraEncoding, CliftVariant};
use crate::network::blocks::attention::{CrossAttention, SelfAttention};
use crate::network::blocks::feed_forward::{Activation, FeedForward};
use crate::network::clift::paper::{PaperClift, networks_without_condenser};
use crate::network::config::{CondenserConfig, ModelConfig, bad};
use crate::network::design::Design;
use crate::network::init::{Init, LayerStyle};
use crate::network::layers::{CONTEXT, Layer, Part, STORED};
use crate::network::tokens::Tokens;
use crate::ops::cluster_attention::cluster_attention;
use crate::ops::linear::linear_in_f32;
use crate::tokens::clusters::ClusterIndex;

/// Heads of the published condensers, whatever the number of encoder and renderer. A network too narrow for them, as in tests,
/// has `num_heads` here too.
const NUM_HEADS: usize = 8;
const MIN_HEAD_WIDTH: usize = 8;

/// One pre-norm decoder layer, in which each centroid attends to the tokens of its cluster, and a gate.
///
/// The published weights depart from the paper: one block; residuals around all three parts; keys and values are all
/// tokens without a norm, so that a cluster of one token attends to itself; `ReLU`; a gate with bias.
#[derive(Module, Debug)]
pub struct ReleasedCondenser {
    released: ReleasedBlock,
}

/// The layers of [`ReleasedCondenser`], whose paths in weight files start with `released`.
#[derive(Module, Debug)]
struct ReleasedBlock {
    norm_self: LayerNorm,
    self_attn: SelfAttention,
    norm_cross: LayerNorm,
    cluster_attn: CrossAttention,
    norm_ff: LayerNorm,
    feed_forward: FeedForward,
    /// `W_z` and `b_z`, zero at the start.
    gate: Linear,
}

impl ReleasedCondenser {
    /// Makes a condenser of the sizes of `config`, with [`NUM_HEADS`] heads.
    pub fn new(config: &ModelConfig, init: &mut Init) -> Self {
        let dim = config.dim;
        let has_published_heads = dim.is_multiple_of(NUM_HEADS * MIN_HEAD_WIDTH);
        let num_heads = if has_published_heads { NUM_HEADS } else { config.num_heads };
        let config = &ModelConfig { num_heads, ..config.clone() };
        // The network for DL3DV has the same condenser: only its encoder and renderer have norms of queries and keys.
        init.without_query_key_norms(|init| Self {
            released: ReleasedBlock {
                norm_self: init.layer_norm(dim),
                self_attn: SelfAttention::new(config, init),
                norm_cross: init.layer_norm(dim),
                cluster_attn: CrossAttention::new(config, init),
                norm_ff: init.layer_norm(dim),
                feed_forward: FeedForward::with(Activation::Relu, dim, config.feed_forward_dim, init),
                gate: init.zero_linear_with_bias(dim, dim),
            },
        })
    }

    /// Returns the gate.
    pub fn gate(&mut self) -> &mut Linear {
        &mut self.released.gate
    }

    /// Compresses every cluster of tokens into its centroid.
    ///
    /// # Shapes
    /// - `centroids` and the result: `[batch, num_storage_tokens, dim]`
    /// - `lift`: `[batch, num_tokens, dim]`
    pub fn forward(&self, centroids: Tokens, lift: Tokens, clusters: &ClusterIndex) -> Tokens {
        let block = &self.released;
        let Tokens { values, transforms } = centroids;
        let x = values.clone() + block.self_attn.forward(&block.norm_self, values.clone(), None);

        let key_value = block.cluster_attn.project_key_value(None, lift);
        let query = block.cluster_attn.project_query(Some(&block.norm_cross), x.clone(), None);
        let attended = cluster_attention(query, key_value, clusters.segment.clone(), block.cluster_attn.num_heads());
        let x = x + block.cluster_attn.project_out(attended, None);

        let x = x.clone() + block.feed_forward.forward(&block.norm_ff, x);
        Tokens { values: values + linear_in_f32(&block.gate, x), transforms }
    }
}

/// The released code's networks for `RealEstate10K` and DL3DV.
pub(crate) struct ReleasedClift;

impl Design for ReleasedClift {
    fn defaults(&self, variant: CliftVariant) -> ModelConfig {
        PaperClift.defaults(variant)
    }

    fn validate(&self, config: &ModelConfig) -> Result<(), ModelError> {
        PaperClift.validate(config)?;
        let ModelConfig { variant, camera_encoding, .. } = config;
        let CondenserConfig { num_blocks, residual, member_share } = config.condenser;
        if *camera_encoding != CameraEncoding::Plucker {
            let fix = format!("model.variant = \"{variant}\" has \"plucker\": leave the key out");
            return bad("model.camera_encoding", camera_encoding, fix);
        }
        if num_blocks != 1 {
            let fix = format!("model.variant = \"{variant}\" has one: leave the key out");
            return bad("model.condenser.num_blocks", num_blocks, fix);
        }
        if !residual {
            let fix = format!("the block of model.variant = \"{variant}\" has residuals: leave the key out");
            return bad("model.condenser.residual", residual, fix);
        }
        if member_share {
            let fix = format!("the block of model.variant = \"{variant}\" adds the whole update: leave the key out");
            return bad("model.condenser.member_share", member_share, fix);
        }
        Ok(())
    }

    fn layers(&self, config: &ModelConfig) -> Vec<Layer> {
        let mut list = networks_without_condenser(config, self.layer_style(config));
        list.style.has_query_key_norms = false;
        list.activation = Activation::Relu;
        list.enter(Part::Condenser, Some(0), "condenser.released");
        list.decoder_block(STORED, CONTEXT);
        list.linear("gate", [config.dim, config.dim], STORED, true);
        list.layers
    }

    fn layer_style(&self, config: &ModelConfig) -> LayerStyle {
        LayerStyle { has_query_key_norms: config.variant.has_norms(), ..LayerStyle::PYTORCH }
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::Tensor;

    use super::*;
    use crate::testing::{check_gradients, devices, random, small_config, to_f64};
    use crate::tokens::clusters::{Clusters, SceneClusters};

    #[test]
    fn published_condensers_have_eight_heads() {
        for (dim, num_heads, expected) in [(512, 8, 8), (768, 12, 8), (16, 4, 4)] {
            let config =
                ModelConfig { dim, num_heads, feed_forward_dim: 8, ..small_config(CliftVariant::ReleasedRe10k) };
            let condenser = ReleasedCondenser::new(&config, &mut Init::new(5, &devices()[0]));
            assert_eq!(condenser.released.cluster_attn.num_heads(), expected, "{dim}");
        }
    }

    #[test]
    fn gradients_equal_central_differences_in_f64() {
        for device in devices() {
            let config = ModelConfig { dim: 16, num_heads: 4, ..small_config(CliftVariant::ReleasedRe10k) };
            let mut init = Init::new(5, &device);
            let mut condenser = ReleasedCondenser::new(&config, &mut init);
            *condenser.gate() = init.linear(16, 16);
            let condenser = to_f64(condenser);
            // Cluster 2 has one token, which attends to itself.
            let scene = SceneClusters::new(vec![0, 1, 1, 2, 1], vec![0, 4, 3]).expect("valid");
            let clusters = Clusters::new(vec![scene]).expect("one");
            let forward = |[values]: [Tensor<3>; 1]| {
                let is_tracked = values.is_autodiff();
                let (device, condenser) = (values.device(), condenser.clone());
                let (device, condenser) =
                    if is_tracked { (device.autodiff(), condenser.train()) } else { (device, condenser) };
                let (lift, clusters) = (Tokens::without_cameras(values), clusters.upload(&device));
                condenser.forward(lift.centroids(&clusters), lift, &clusters).values
            };
            check_gradients([random([1, 5, 16], 6, &device)], forward, 1e-6);
        }
    }
}
