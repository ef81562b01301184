//! The condenser of the released networks.
// B scenes, N tokens, S centroids, D width

use burn::module::Module;
use burn::nn::{LayerNorm, Linear};
use burn::tensor::Tensor;

use crate::network::architecture::CliftVariant;
use crate::network::blocks::attention::{CrossAttention, SelfAttention};
use crate::network::blocks::feed_forward::{Activation, FeedForward};
use crate::network::config::ModelConfig;
use crate::network::init::Init;
use crate::ops::cluster_attention::cluster_attention;
use crate::ops::linear::linear_in_f32;
use crate::tokens::clusters::ClusterIndex;

/// One pre-norm decoder layer, in which each centroid attends to the tokens of its cluster, and a gate.
///
/// The published weights depart from the paper: one block; residuals around all three parts; keys and values are all
/// tokens without a norm, so that a cluster of one token attends to itself; `ReLU`; a gate with bias.
#[derive(Module, Debug)]
pub(crate) struct ReleasedCondenser {
    norm_self: LayerNorm,
    self_attn: SelfAttention,
    norm_cross: LayerNorm,
    cluster_attn: CrossAttention,
    norm_ff: LayerNorm,
    feed_forward: FeedForward,
    /// `W_z` and `b_z`, zero at the start.
    pub(super) gate: Linear,
}

impl ReleasedCondenser {
    pub fn new(config: &ModelConfig, init: &mut Init) -> Self {
        // The network for DL3DV has the same condenser: only its encoder and renderer have norms of queries and keys.
        let config = &ModelConfig { variant: CliftVariant::ReleasedRe10k, ..config.clone() };
        let dim = config.dim;
        Self {
            norm_self: init.layer_norm(dim),
            self_attn: SelfAttention::new(config, init),
            norm_cross: init.layer_norm(dim),
            cluster_attn: CrossAttention::new(config, init),
            norm_ff: init.layer_norm(dim),
            feed_forward: FeedForward::with(Activation::Relu, dim, config.feed_forward_dim, init),
            gate: init.zero_linear_with_bias(dim, dim),
        }
    }

    /// Compresses every cluster of tokens into its centroid.
    ///
    /// # Shapes
    /// - `centroids` and the result: `[batch, num_storage_tokens, dim]`
    /// - `lift`: `[batch, num_tokens, dim]`
    pub fn forward(&self, centroids: Tensor<3>, lift: Tensor<3>, clusters: &ClusterIndex) -> Tensor<3> {
        let x = centroids.clone() + self.self_attn.forward(&self.norm_self, centroids.clone(), None);

        let key_value = self.cluster_attn.project_key_value(None, lift.into());
        let query = self.cluster_attn.project_query(Some(&self.norm_cross), x.clone(), None);
        let attended = cluster_attention(query, key_value, clusters.segment.clone(), self.cluster_attn.num_heads());
        let x = x + self.cluster_attn.project_out(attended, None);

        let x = x.clone() + self.feed_forward.forward(&self.norm_ff, x);
        centroids + linear_in_f32(&self.gate, x)
    }
}
