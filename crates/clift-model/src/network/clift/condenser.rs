//! The condenser of the paper (section 3.2, equations 1 to 4).
// B scenes, M members, D width

use burn::module::Module;
use burn::nn::{LayerNorm, Linear};
use burn::tensor::Tensor;

use crate::network::blocks::attention::{CrossAttention, SelfAttention};
use crate::network::blocks::feed_forward::FeedForward;
use crate::network::camera_encoding::TokenTransforms;
use crate::network::config::ModelConfig;
use crate::network::init::Init;
use crate::network::tokens::Tokens;
use crate::ops::cluster_attention::cluster_attention;
use crate::ops::linear::linear_in_f32;
use crate::tokens::clusters::ClusterIndex;

/// Condenser blocks; a condenser without blocks returns the centroids.
#[derive(Module, Debug)]
pub struct PaperCondenser {
    blocks: Vec<CondenserBlock>,
}

/// One round of equations 1 to 4 on the centroids `c` and the members `m` of each cluster: `eq1 = self_attention(c)`,
/// `eq2 = cluster_attention(eq1, m)`, `eq3 = feed_forward(eq2)`; the result is `c + W_z eq3`.
#[derive(Module, Debug)]
struct CondenserBlock {
    norm_self: LayerNorm,
    self_attn: SelfAttention,
    /// Present with residuals only: the printed equation 2 has no norm of the query.
    norm_cross: Option<LayerNorm>,
    norm_memory: LayerNorm,
    cluster_attn: CrossAttention,
    norm_ff: LayerNorm,
    feed_forward: FeedForward,
    /// `W_z` of equation 4, zero at the start.
    gate: Linear,
    /// Whether a cluster's share of members multiplies what equation 4 adds.
    member_share: bool,
}

impl PaperCondenser {
    /// Makes a condenser of the sizes of `config`.
    pub fn new(config: &ModelConfig, init: &mut Init) -> Self {
        Self { blocks: (0..config.condenser.num_blocks).map(|_| CondenserBlock::new(config, init)).collect() }
    }

    /// Returns the gates of all blocks.
    pub fn gates(&mut self) -> impl Iterator<Item = &mut Linear> {
        self.blocks.iter_mut().map(|block| &mut block.gate)
    }

    /// Compresses every cluster of tokens into its centroid.
    ///
    /// # Shapes
    /// - `centroids` and the result: `[batch, num_storage_tokens, dim]`
    /// - `lift`: `[batch, num_tokens, dim]`
    pub fn forward(&self, centroids: Tokens, lift: &Tokens, clusters: &ClusterIndex) -> Tokens {
        // "The remaining LiFTs": a centroid is not among its keys.
        let members = clusters.members.as_ref().map(|members| lift.gather(clusters, &members.token)); // [B, M, D]
        let forward = |centroids, block: &CondenserBlock| block.forward(centroids, members.as_ref(), clusters);
        self.blocks.iter().fold(centroids, forward)
    }
}

impl CondenserBlock {
    fn new(config: &ModelConfig, init: &mut Init) -> Self {
        let dim = config.dim;
        Self {
            norm_self: init.layer_norm(dim),
            self_attn: SelfAttention::new(config, init),
            norm_cross: config.condenser.residual.then(|| init.layer_norm(dim)),
            norm_memory: init.layer_norm(dim),
            cluster_attn: CrossAttention::new(config, init),
            norm_ff: init.layer_norm(dim),
            feed_forward: FeedForward::new(dim, config.feed_forward_dim, init),
            gate: init.zero_linear(dim, dim),
            member_share: config.condenser.member_share,
        }
    }

    /// Applies equations 1 to 4. Without members, every cluster is one token and equation 2 does nothing.
    fn forward(&self, centroids: Tokens, members: Option<&Tokens>, clusters: &ClusterIndex) -> Tokens {
        let Tokens { values: centroids, transforms } = centroids;
        let attended = self.self_attn.forward(&self.norm_self, centroids.clone(), transforms.as_ref());
        let eq1 = self.residual(&centroids, attended);
        let eq2 = match members {
            Some(members) => self.attend_members(eq1, transforms.as_ref(), members.clone(), clusters),
            None => eq1,
        };
        let eq3 = self.residual(&eq2, self.feed_forward.forward(&self.norm_ff, eq2.clone()));
        let mut update = linear_in_f32(&self.gate, eq3);
        if self.member_share {
            let share = clusters.member_share.clone().cast(update.dtype());
            update = update * share;
        }
        Tokens { values: centroids + update, transforms } // equation 4
    }

    /// Equation 2: each centroid attends to the members of its cluster. A cluster of one token has no keys and keeps the
    /// value of equation 1.
    fn attend_members(
        &self,
        eq1: Tensor<3>,
        transforms: Option<&TokenTransforms>,
        members: Tokens,
        clusters: &ClusterIndex,
    ) -> Tensor<3> {
        let segment = clusters.members.as_ref().expect("there are members").segment.clone();
        let key_value = self.cluster_attn.project_key_value(Some(&self.norm_memory), members);
        let query = self.cluster_attn.project_query(self.norm_cross.as_ref(), eq1.clone(), transforms);
        let attended = cluster_attention(query, key_value, segment, self.cluster_attn.num_heads());
        let eq2 = self.residual(&eq1, self.cluster_attn.project_out(attended, transforms));
        match &clusters.singleton {
            Some(singleton) => eq2.clone().mask_where(singleton.clone().expand(eq2.dims()), eq1),
            None => eq2,
        }
    }

    /// Adds the input to the output ("Add & `LayerNorm`" of the paper's text), or returns the output as equations 1 to 3
    /// print it.
    fn residual(&self, input: &Tensor<3>, output: Tensor<3>) -> Tensor<3> {
        if self.norm_cross.is_some() { input.clone() + output } else { output }
    }
}
